"""Point-to-surface distances: residuals for identification, and the Chamfer distance for reports."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from .._utils.caching import VersionedTensorCache
from .._utils.linalg import cross, dot, safe_norm
from .._utils.torch_modes import disable_autocast
from .nearest import find_nearest_triangles
from .shapes import as_tensor, check_points, check_triangles


class ClosestPoints(NamedTuple):
    """Closest points on a surface for N measured points; constant under differentiation (envelope theorem).

    Attributes:
        corners: [N, 3] int64, vertices of the triangle.
        weights: [N, 3] -, barycentric coordinates.
        is_beyond_edge: [N] bool, the measured point lies beyond the edge of the sheet.
    """

    corners: Tensor
    weights: Tensor
    is_beyond_edge: Tensor

    def interpolate(self, vertices: Tensor) -> Tensor:
        """Return the positions of the closest points, [..., N, 3] m, for vertices [..., V, 3] m."""
        picked = vertices.index_select(-2, self.corners.reshape(-1)).unflatten(-2, (-1, 3))
        return (self.weights.unsqueeze(-1) * picked).sum(-2)


@disable_autocast()
def find_closest_points(points: Tensor, vertices: Tensor, faces: Tensor, chunk: int = 4_000_000) -> ClosestPoints:
    """Find the exact closest points on a triangle mesh.

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
    """Compute distances [m] of points from the surface, along its normal and in its plane.

    Points beyond the sheet's edge pull the edge outwards. Missing points do not pull it back: occlusion explains them.

    Args:
        points: [N, 3] m.
        vertices: [..., V, 3] m, differentiable.
        closest_points: as ``find_closest_points`` returned them.

    Returns:
        Signed distance along the normal [N]; and distance in the surface's plane [N], 0 unless the point lies beyond
        the sheet's edge.
    """
    points, vertices = as_tensor(points), as_tensor(vertices)
    x0, x1, x2 = vertices.index_select(-2, closest_points.corners.reshape(-1)).unflatten(-2, (-1, 3)).unbind(-2)
    normal = cross(x1 - x0, x2 - x0)
    size = safe_norm(normal)
    normal = normal / torch.where(size > 0, size, 1.0)  # a triangle without area has none
    offset = points - closest_points.interpolate(vertices)
    along = dot(normal, offset)
    tangential = offset - along * normal
    is_beyond = closest_points.is_beyond_edge.unsqueeze(-1)
    in_plane = safe_norm(torch.where(is_beyond, tangential, torch.zeros_like(tangential)))
    return along.squeeze(-1), in_plane.squeeze(-1)


def chamfer_to_surface(points: Tensor, vertices: Tensor, faces: Tensor) -> Tensor:
    """Compute the one-sided Chamfer distance cloud -> surface [m]: the mean distance to the nearest triangle.

    It is differentiable in ``vertices``. Its floor is the sensor noise, and it is blind to motion within the surface:
    use it to report, and ``residuals`` to infer.

    Raises:
        InvalidInput: as ``find_closest_points``, or no points.
    """
    points, vertices = as_tensor(points), as_tensor(vertices)
    check_points(points, "points", min_count=1)
    return point_distances(points, vertices, find_closest_points(points, vertices, faces)).mean()


def point_distances(points: Tensor, vertices: Tensor, closest_points: ClosestPoints) -> Tensor:
    """Return the distances [N] m of points from their closest points; differentiable in ``vertices``."""
    return safe_norm(as_tensor(points) - closest_points.interpolate(as_tensor(vertices))).squeeze(-1)


def _on_boundary(faces: Tensor, face: Tensor, weights: Tensor) -> Tensor:
    """Return [N] bool, whether the closest point lies on an edge of one triangle only, or is an end of one."""
    open_edge, rim = _boundary(faces)
    corner = rim[faces[face].gather(-1, weights.argmax(-1, keepdim=True)).squeeze(-1)] & (weights >= 1).any(-1)
    return ((weights <= 0) & open_edge[face]).any(-1) | corner


def _boundary(faces: Tensor) -> tuple[Tensor, Tensor]:
    """Return [F, 3] bool, is the edge opposite to each corner open; and [V] bool, is the vertex an end of one."""
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
