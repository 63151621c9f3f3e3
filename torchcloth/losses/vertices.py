"""Point-to-vertex distances, for comparison with papers that use them."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from .._utils.linalg import EXACT_CDIST_MODE
from ..errors import InvalidInput
from .shapes import as_tensor, check_points

MAX_DISTANCES_PER_BLOCK = 4_000_000  # that are in memory at the same time


def chamfer_to_vertices(points: Tensor, vertices: Tensor, norm: Literal[1, 2] = 2) -> Tensor:
    """Compute the one-sided Chamfer distance cloud -> vertices [m]: the mean distance to the nearest vertex.

    It depends on the mesh density, and its floor is about a third of an edge. Norm 2 is the DiffCP paper's loss. Norm 1
    is RGBench's "Chamfer L1, real to sim" (Hu et al. 2026), which adds the three coordinates of a distance: up to 1.73
    times its length.

    Args:
        points: [N, 3] m.
        vertices: [V, 3] m, differentiable.
        norm: of a distance, also where the nearest vertex is searched.

    Raises:
        InvalidInput: other shapes, none of either, or another norm.
    """
    if norm not in (1, 2):
        raise InvalidInput("norm", got=norm, expected="1 or 2")
    points, vertices = as_tensor(points), as_tensor(vertices)
    check_points(points, "points", min_count=1)
    check_points(vertices, "vertices", min_count=1)
    if points.dtype != vertices.dtype:
        raise InvalidInput("points", got=points.dtype, expected=f"the vertices' precision, {vertices.dtype}")
    with torch.no_grad():
        # from products of coordinates, distances would have no digits far from the origin
        blocks = points.split(max(1, MAX_DISTANCES_PER_BLOCK // len(vertices)))
        distances = (torch.cdist(part, vertices, p=norm, compute_mode=EXACT_CDIST_MODE) for part in blocks)
        nearest = torch.cat([block.argmin(-1) for block in distances])
    return (points - vertices[nearest]).norm(p=norm, dim=-1).mean()
