"""Point-to-surface distances: the residuals that identification uses, and the Chamfer distance for reports."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from .._utils.caching import VersionedTensorCache
from .._utils.linalg import cross, dot, safe_norm
from .._utils.torch_modes import disable_autocast
from .nearest import find_nearest_triangles
from .shapes import check_points, check_triangles, as_tensor


class ClosestPoints(NamedTuple):
    """Closest surface points of N measured points; held constant while differentiating (envelope theorem)."""

    corners: Tensor  # [N, 3] int64, vertices of the triangle that was hit
    weights: Tensor  # [N, 3] -, barycentric coordinates
    is_beyond_edge: Tensor  # [N] bool, the point lies beyond the sheet's edge

    def interpolate(self, vertices: Tensor) -> Tensor:
        """[..., N, 3] m, the material points that were hit, on vertices [..., V, 3]."""
        picked = vertices.index_select(-2, self.corners.reshape(-1)).unflatten(-2, (-1, 3))
        return (self.weights.unsqueeze(-1) * picked).sum(-2)


@disable_autocast()
def find_closest_points(points: Tensor, vertices: Tensor, faces: Tensor, chunk: int = 4_000_000) -> ClosestPoints:
    """Exact closest points on a triangle mesh.

    Args:
        points: [N, 3] m; N may be 0.
        vertices: [V, 3] m.
        faces: [F, 3] int64.
        chunk: point-triangle pairs per pass, where torch searches.

    Raises:
        InvalidInput: other shapes, no faces, indices of no vertex, two precisions, or numbers that are not finite.
    """
    points, vertices, faces = as_tensor(points), as_tensor(vertices), as_tensor(faces)
    check_points(points, "points")
    check_points(vertices, "vertices")
    check_triangles(faces, len(vertices))
    with torch.no_grad():
        points, vertices = points.detach(), vertices.detach()
        face, weights = find_nearest_triangles(points, vertices[faces], chunk)
        return ClosestPoints(faces[face], weights, _on_boundary(faces, face, weights))


def residuals(points: Tensor, vertices: Tensor, closest_points: ClosestPoints) -> tuple[Tensor, Tensor]:
    """Signed distances [m] of points from the surface, split by direction.

    Returns:
        (along the normal [N], for every point; in the surface's plane [N], for points beyond the sheet's edge and 0
        elsewhere: points beyond pull the edge outwards, missing points do not pull it back, occlusion explains them)
    """
    points, vertices = as_tensor(points), as_tensor(vertices)
    x0, x1, x2 = vertices.index_select(-2, closest_points.corners.reshape(-1)).unflatten(-2, (-1, 3)).unbind(-2)
    normal = cross(x1 - x0, x2 - x0)
    size = safe_norm(normal)
    normal = normal / torch.where(size > 0, size, 1.0)  # a triangle without area has none
    offset = points - closest_points.interpolate(vertices)
    along = dot(normal, offset)
    beside = offset - along * normal
    beside = safe_norm(torch.where(closest_points.is_beyond_edge.unsqueeze(-1), beside, torch.zeros_like(beside)))
    return along.squeeze(-1), beside.squeeze(-1)


def chamfer_to_surface(points: Tensor, vertices: Tensor, faces: Tensor) -> Tensor:
    """One-sided Chamfer distance cloud -> surface [m]: mean over the points of the distance to the nearest triangle.

    Differentiable in ``vertices``. Its floor is the sensor noise, and it is blind to motion within the surface: use it
    to report, and ``residuals`` to infer.

    Raises:
        InvalidInput: as `closest`, or no points, which have no mean.
    """
    points, vertices = as_tensor(points), as_tensor(vertices)
    check_points(points, "points", min_count=1)
    return point_distances(points, vertices, find_closest_points(points, vertices, faces)).mean()


def point_distances(points: Tensor, vertices: Tensor, closest_points: ClosestPoints) -> Tensor:
    """[N] m, of points from the places that they hit; differentiable in ``vertices``."""
    return safe_norm(as_tensor(points) - closest_points.interpolate(as_tensor(vertices))).squeeze(-1)


def _on_boundary(faces: Tensor, face: Tensor, weights: Tensor) -> Tensor:
    """[N] bool, whether the closest point lies on an edge that only one triangle has, or is an end of one."""
    open_edge, rim = _boundary(faces)
    corner = rim[faces[face].gather(-1, weights.argmax(-1, keepdim=True)).squeeze(-1)] & (weights >= 1).any(-1)
    return ((weights <= 0) & open_edge[face]).any(-1) | corner


def _boundary(faces: Tensor) -> tuple[Tensor, Tensor]:
    """([F, 3] bool, whether the edge opposite to each corner is open; [V] bool, whether a vertex is an end of one)."""
    return _MESH_BOUNDARIES.get_or_compute(faces, lambda: _find_boundary(faces))


_MESH_BOUNDARIES: VersionedTensorCache[tuple[Tensor, Tensor]] = VersionedTensorCache()


def _find_boundary(faces: Tensor) -> tuple[Tensor, Tensor]:
    faces = faces.long()  # numbers of edges are beyond 32 bits
    edges = torch.stack([faces[:, [1, 2]], faces[:, [2, 0]], faces[:, [0, 1]]], dim=1).sort(-1).values
    number = edges[..., 0] * (faces.max() + 1) + edges[..., 1]  # one for each edge: sorts far faster than rows
    _, inverse, count = number.flatten().unique(return_inverse=True, return_counts=True)
    open_edge = (count[inverse] == 1).reshape(-1, 3)
    rim = torch.zeros(int(faces.max()) + 1, dtype=torch.bool, device=faces.device)
    rim[edges[open_edge].flatten()] = True
    return open_edge, rim
