"""Point-to-vertex distances, for comparison with papers that use them."""

from __future__ import annotations

import torch
from torch import Tensor

from .._utils.linalg import EXACT_CDIST_MODE
from ..errors import InvalidInput
from .shapes import as_tensor, check_points

MAX_DISTANCES_PER_BLOCK = 4_000_000  # that are in memory at the same time


def chamfer_to_vertices(points: Tensor, vertices: Tensor) -> Tensor:
    """Compute the one-sided Chamfer distance cloud -> vertices [m]: the mean distance to the nearest vertex.

    This is the DiffCP paper's loss. It depends on the mesh density, and its floor is about a third of an edge.

    Args:
        points: [N, 3] m.
        vertices: [V, 3] m, differentiable.

    Raises:
        InvalidInput: other shapes, or none of either.
    """
    points, vertices = as_tensor(points), as_tensor(vertices)
    check_points(points, "points", min_count=1)
    check_points(vertices, "vertices", min_count=1)
    if points.dtype != vertices.dtype:
        raise InvalidInput("points", got=points.dtype, expected=f"the vertices' precision, {vertices.dtype}")
    with torch.no_grad():
        # from products of coordinates, distances would have no digits far from the origin
        blocks = points.split(max(1, MAX_DISTANCES_PER_BLOCK // len(vertices)))
        nearest = torch.cat([torch.cdist(part, vertices, compute_mode=EXACT_CDIST_MODE).argmin(-1) for part in blocks])
    return (points - vertices[nearest]).norm(dim=-1).mean()
