"""Nearest places on triangles: all triangles that may be nearest, by their bounding spheres, are tried."""

from __future__ import annotations

import torch
from torch import Tensor

from .._utils.linalg import EXACT_CDIST_MODE, cross
from ..engine.nearest import find_nearest_triangles_compiled
from ..errors import InvalidInput


def find_nearest_triangles(points: Tensor, corners: Tensor, chunk: int) -> tuple[Tensor, Tensor]:
    """Find the nearest triangle of each point, by the compiled library where it is built, else in torch.

    Args:
        points: [N, 3] m.
        corners: [F, 3, 3] m, corners of the triangles.
        chunk: point-triangle pairs per pass, where torch searches.

    Returns:
        The triangles [N], the first of several equally near, and barycentric coordinates [N, 3] of the nearest places.

    Raises:
        InvalidInput: two precisions, or numbers that are not finite.
    """
    if points.dtype != corners.dtype:
        raise InvalidInput("points and vertices", got=f"{points.dtype} and {corners.dtype}", expected="one precision")
    result = find_nearest_triangles_compiled(points, corners)
    if result is None:
        parts = [_search(part, corners) for part in points.split(max(1, chunk // len(corners)))]
        result = torch.cat([face for face, _ in parts]), torch.cat([weights for _, weights in parts])
    return result


def _search(points: Tensor, corners: Tensor) -> tuple[Tensor, Tensor]:
    if not bool(points.isfinite().all() & corners.isfinite().all()):
        raise InvalidInput("points or vertices", got="NaN or infinite entries", expected="finite metres")
    point, triangle = _candidate_pairs(points, corners)
    weights, squared = _project_on_triangles(points[point], corners[triangle])
    smallest = squared.new_full((len(points),), torch.inf).scatter_reduce(0, point, squared, "amin")
    pair = torch.arange(len(point), device=points.device)
    pair = torch.where(squared == smallest[point], pair, len(pair))
    first = pair.new_full((len(points),), len(pair)).scatter_reduce(0, point, pair, "amin")
    return triangle[first], weights[first]


def _candidate_pairs(points: Tensor, corners: Tensor) -> tuple[Tensor, Tensor]:
    """Return pairs of points [M] and triangles [M], ordered by points, without triangles that cannot be nearest."""
    centre = corners.mean(1)
    radius = (corners - centre[:, None]).norm(dim=-1).amax(1)
    distance = torch.cdist(points, centre, compute_mode=EXACT_CDIST_MODE)
    slack = 1 + 16 * torch.finfo(points.dtype).eps
    reach = slack * (distance + radius).amin(1, keepdim=True)
    point, triangle = (distance - radius <= reach).nonzero(as_tuple=True)
    return point, triangle


def _project_on_triangles(points: Tensor, corners: Tensor) -> tuple[Tensor, Tensor]:
    """Return barycentric coordinates [M, 3] and squared distances [M] of the nearest places on a triangle each."""
    candidates = [_project_inside(points, corners), *(_project_edge(points, corners, i) for i in range(3))]
    weights = torch.stack(candidates)  # [4, M, 3]
    offset = points - sum(weights[..., i, None] * corners[:, i] for i in range(3))
    squared, kind = _inner(offset, offset).min(0)
    return weights[kind, torch.arange(len(points), device=points.device)], squared


def _project_inside(points: Tensor, corners: Tensor) -> Tensor:
    """Return barycentric coordinates [M, 3] of the projection on the plane; the first corner if that is outside."""
    a, b, c = corners.unbind(1)
    e1, e2, offset = b - a, c - a, points - a
    normal = cross(e1, e2)
    scale = normal / _inner(normal, normal)[:, None]
    v, w = _inner(cross(offset, e2), scale), _inner(cross(e1, offset), scale)
    weights = torch.stack([1 - v - w, v, w], dim=-1)
    outside = ~(weights >= 0).all(-1, keepdim=True)  # NaN for a triangle without area
    return torch.where(outside, torch.eye(3, dtype=a.dtype, device=a.device)[0], weights)


def _project_edge(points: Tensor, corners: Tensor, start: int) -> Tensor:
    """Return barycentric coordinates [M, 3] of the nearest point on the edge from corner ``start`` to the next."""
    end = (start + 1) % 3
    a, edge = corners[:, start], corners[:, end] - corners[:, start]
    length = _inner(edge, edge).clamp(min=torch.finfo(edge.dtype).tiny)  # 0 where both corners are the same point
    t = (_inner(points - a, edge) / length).clamp(0.0, 1.0)
    weights = t.new_zeros(*t.shape, 3)
    weights[..., start], weights[..., end] = 1 - t, t
    return weights


def _inner(a: Tensor, b: Tensor) -> Tensor:
    """Return the inner product over a last axis of three, [...], faster than a sum where no derivative is needed."""
    return sum(x * y for x, y in zip(a.unbind(-1), b.unbind(-1), strict=True))  # type: ignore[return-value]
