"""Point-to-vertex distances, for comparison with papers that use them."""

from __future__ import annotations

import torch
from torch import Tensor

from .._utils.linalg import EXACT
from ..errors import InvalidInput
from .shapes import check_places, taken

AT_A_TIME = 4_000_000  # distances


def chamfer_to_vertices(points: Tensor, vertices: Tensor) -> Tensor:
    """One-sided Chamfer distance cloud -> vertices [m]: mean over the points of the distance to the nearest vertex.

    The DiffCP paper's loss. It depends on the mesh density and its floor is about a third of an edge.

    Args:
        points: [N, 3] m.
        vertices: [V, 3] m, differentiable.

    Raises:
        InvalidInput: other shapes, or none of either.
    """
    points, vertices = taken(points), taken(vertices)
    check_places(points, "points", least=1)
    check_places(vertices, "vertices", least=1)
    if points.dtype != vertices.dtype:
        raise InvalidInput("points", got=points.dtype, expected=f"the vertices' precision, {vertices.dtype}")
    with torch.no_grad():
        # by products of the coordinates, distances would lose their digits far from the origin
        some = points.split(max(1, AT_A_TIME // len(vertices)))
        nearest = torch.cat([torch.cdist(part, vertices, compute_mode=EXACT).argmin(-1) for part in some])
    return (points - vertices[nearest]).norm(dim=-1).mean()
