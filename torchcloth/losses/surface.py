"""Point-to-surface distances: the residuals that identification uses, and the Chamfer distance for reports."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from .._math import cross, dot, safe_norm


class Hits(NamedTuple):
    """Closest surface points of N measured points; held constant while differentiating (envelope theorem)."""

    corners: Tensor  # [N, 3] int64, vertices of the triangle that was hit
    weights: Tensor  # [N, 3] -, barycentric coordinates
    beyond: Tensor  # [N] bool, the point lies beyond the sheet's edge

    def on(self, vertices: Tensor) -> Tensor:
        """[..., N, 3] m, the material points that were hit, on vertices [..., V, 3]."""
        picked = vertices.index_select(-2, self.corners.reshape(-1)).unflatten(-2, (-1, 3))
        return (self.weights.unsqueeze(-1) * picked).sum(-2)


def closest(points: Tensor, vertices: Tensor, faces: Tensor, chunk: int = 4_000_000) -> Hits:
    """Exact closest points on a triangle mesh: all triangles that may be nearest by their bounding spheres are tried.

    Args:
        points: [N, 3] m.
        vertices: [V, 3] m.
        faces: [F, 3] int64.
        chunk: point-triangle pairs per pass.
    """
    with torch.no_grad():
        points, vertices = points.detach(), vertices.detach()
        corners = vertices[faces]
        found = [_closest(part, corners) for part in points.split(max(1, chunk // len(faces)))]
        face = torch.cat([f for f, _ in found])
        weights = torch.cat([w for _, w in found])
        return Hits(faces[face], weights, _on_boundary(faces, face, weights))


def residuals(points: Tensor, vertices: Tensor, hits: Hits) -> tuple[Tensor, Tensor]:
    """Signed distances [m] of points from the surface, split by direction.

    Returns:
        (along the normal [N], for every point; in the surface's plane [N], for points beyond the sheet's edge and 0
        elsewhere: points beyond pull the edge outwards, missing points do not pull it back, occlusion explains them)
    """
    x0, x1, x2 = vertices.index_select(-2, hits.corners.reshape(-1)).unflatten(-2, (-1, 3)).unbind(-2)
    normal = cross(x1 - x0, x2 - x0)
    normal = normal / dot(normal, normal).sqrt()
    offset = points - hits.on(vertices)
    along = dot(normal, offset)
    beside = offset - along * normal
    beside = safe_norm(torch.where(hits.beyond.unsqueeze(-1), beside, torch.zeros_like(beside)))
    return along.squeeze(-1), beside.squeeze(-1)


def chamfer_to_surface(points: Tensor, vertices: Tensor, faces: Tensor) -> Tensor:
    """One-sided Chamfer distance cloud -> surface [m]: mean over the points of the distance to the nearest triangle.

    Differentiable in ``vertices``. Its floor is the sensor noise, and it is blind to motion within the surface: use it
    to report, and ``residuals`` to infer.
    """
    return distances(points, vertices, closest(points, vertices, faces)).mean()


def distances(points: Tensor, vertices: Tensor, hits: Hits) -> Tensor:
    """[N] m, of points from the places that they hit; differentiable in ``vertices``."""
    return safe_norm(points - hits.on(vertices)).squeeze(-1)


def _closest(points: Tensor, corners: Tensor) -> tuple[Tensor, Tensor]:
    """(nearest triangle [N], the first of several; barycentric coordinates [N, 3]) on triangles [F, 3, 3]."""
    point, triangle = _near(points, corners)
    offset, x = points[point], corners[triangle]
    weights, squared = _on_triangles(offset, x)
    least = squared.new_full((len(points),), torch.inf).scatter_reduce(0, point, squared, "amin")
    pair = torch.arange(len(point), device=points.device)
    pair = torch.where(squared == least[point], pair, len(pair))
    first = pair.new_full((len(points),), len(pair)).scatter_reduce(0, point, pair, "amin")
    return triangle[first], weights[first]


def _near(points: Tensor, corners: Tensor) -> tuple[Tensor, Tensor]:
    """Pairs (point [M], triangle [M]), by points, that leave out only triangles beyond another's farthest place."""
    centre = corners.mean(1)
    radius = (corners - centre[:, None]).norm(dim=-1).amax(1)
    distance = torch.cdist(points, centre, compute_mode="donot_use_mm_for_euclid_dist")
    slack = 1 + 16 * torch.finfo(points.dtype).eps
    reach = slack * (distance + radius).amin(1, keepdim=True)
    point, triangle = (distance - radius <= reach).nonzero(as_tuple=True)
    return point, triangle


def _on_triangles(points: Tensor, corners: Tensor) -> tuple[Tensor, Tensor]:
    """(barycentric coordinates [M, 3], squared distance [M]) of the closest places on one triangle [M, 3, 3] each."""
    candidates = [_project_inside(points, corners), *(_project_edge(points, corners, i) for i in range(3))]
    weights = torch.stack(candidates)  # [4, M, 3]
    offset = points - sum(weights[..., i, None] * corners[:, i] for i in range(3))
    squared, kind = _inner(offset, offset).min(0)
    return weights[kind, torch.arange(len(points), device=points.device)], squared


def _project_inside(points: Tensor, corners: Tensor) -> Tensor:
    """Barycentric coordinates [M, 3] of the plane projection; the first corner where that falls outside."""
    a, b, c = corners.unbind(1)
    e1, e2, offset = b - a, c - a, points - a
    normal = cross(e1, e2)
    scale = normal / _inner(normal, normal)[:, None]
    v, w = _inner(cross(offset, e2), scale), _inner(cross(e1, offset), scale)
    weights = torch.stack([1 - v - w, v, w], dim=-1)
    outside = (weights < 0).any(-1, keepdim=True)
    return torch.where(outside, torch.eye(3, dtype=a.dtype, device=a.device)[0], weights)


def _project_edge(points: Tensor, corners: Tensor, start: int) -> Tensor:
    """Barycentric coordinates [M, 3] of the closest point on the edge from corner ``start`` to the next."""
    end = (start + 1) % 3
    a, edge = corners[:, start], corners[:, end] - corners[:, start]
    t = (_inner(points - a, edge) / _inner(edge, edge)).clamp(0.0, 1.0)
    weights = t.new_zeros(*t.shape, 3)
    weights[..., start], weights[..., end] = 1 - t, t
    return weights


def _inner(a: Tensor, b: Tensor) -> Tensor:
    """[...], over a last axis of three: a fraction of the time that a sum takes, without derivatives."""
    return sum(x * y for x, y in zip(a.unbind(-1), b.unbind(-1), strict=True))  # type: ignore[return-value]


def _on_boundary(faces: Tensor, face: Tensor, weights: Tensor) -> Tensor:
    """[N] bool, whether the closest point lies on an edge that only one triangle has."""
    edges = torch.stack([faces[:, [1, 2]], faces[:, [2, 0]], faces[:, [0, 1]]], dim=1).sort(-1).values
    number = edges[..., 0] * (faces.max() + 1) + edges[..., 1]  # one number for each edge: sorts far faster than rows
    _, inverse, count = number.flatten().unique(return_inverse=True, return_counts=True)
    open_edge = (count[inverse] == 1).reshape(-1, 3)  # the edge opposite to each corner
    return ((weights <= 0) & open_edge[face]).any(-1)
