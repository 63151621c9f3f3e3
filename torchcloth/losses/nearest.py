"""Which place on which triangle is nearest: all that may be by their bounding spheres are tried."""

from __future__ import annotations

import torch
from torch import Tensor

from .._utils.linalg import EXACT_CDIST_MODE, cross
from ..engine.library import at_hand
from ..errors import InvalidInput

LETTERS = {torch.float32: "f", torch.float64: "d"}


def find_nearest_triangles(points: Tensor, corners: Tensor, chunk: int) -> tuple[Tensor, Tensor]:
    """(triangle [N], the first of several; barycentric coordinates [N, 3]) of points [N, 3] on triangles [F, 3, 3].

    By the engine's library, where that is at hand; ``chunk``: pairs per pass, where torch searches.
    """
    if points.dtype != corners.dtype:
        raise InvalidInput("points and vertices", got=f"{points.dtype} and {corners.dtype}", expected="one precision")
    found = _compiled(points, corners)
    if found is None:
        parts = [_closest(part, corners) for part in points.split(max(1, chunk // len(corners)))]
        found = torch.cat([face for face, _ in parts]), torch.cat([weights for _, weights in parts])
    return found


def _compiled(points: Tensor, corners: Tensor) -> tuple[Tensor, Tensor] | None:
    """None: the library is not here, not for such tensors, or something is not finite."""
    letter = LETTERS.get(points.dtype)
    if letter is None or corners.dtype != points.dtype or points.device.type != "cpu" or corners.device.type != "cpu":
        return None
    if (lib := at_hand()) is None:
        return None
    points, corners = points.contiguous(), corners.contiguous()
    face, weights = torch.empty(len(points), dtype=torch.int64), torch.empty_like(points)
    try:
        own, into = (points.data_ptr(), corners.data_ptr()), (face.data_ptr(), weights.data_ptr())
    except RuntimeError:  # tensors of torch.func have no memory
        return None
    failed = getattr(lib, f"tc_nearest_{letter}")(own[0], len(points), own[1], len(corners), *into)
    finite = bool(points.isfinite().all() & corners.isfinite().all())  # it passes over triangles that are not
    return (face, weights) if finite and not failed and bool((face >= 0).all()) else None


def _closest(points: Tensor, corners: Tensor) -> tuple[Tensor, Tensor]:
    """``nearest`` in torch."""
    if not bool(points.isfinite().all() & corners.isfinite().all()):
        raise InvalidInput("points or vertices", got="NaN or infinite entries", expected="finite metres")
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
    distance = torch.cdist(points, centre, compute_mode=EXACT_CDIST_MODE)
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
    outside = ~(weights >= 0).all(-1, keepdim=True)  # of a triangle without area they are no numbers
    return torch.where(outside, torch.eye(3, dtype=a.dtype, device=a.device)[0], weights)


def _project_edge(points: Tensor, corners: Tensor, start: int) -> Tensor:
    """Barycentric coordinates [M, 3] of the closest point on the edge from corner ``start`` to the next."""
    end = (start + 1) % 3
    a, edge = corners[:, start], corners[:, end] - corners[:, start]
    length = _inner(edge, edge).clamp(min=torch.finfo(edge.dtype).tiny)  # a corner twice is a point
    t = (_inner(points - a, edge) / length).clamp(0.0, 1.0)
    weights = t.new_zeros(*t.shape, 3)
    weights[..., start], weights[..., end] = 1 - t, t
    return weights


def _inner(a: Tensor, b: Tensor) -> Tensor:
    """[...], over a last axis of three: a fraction of the time that a sum takes, without derivatives."""
    return sum(x * y for x, y in zip(a.unbind(-1), b.unbind(-1), strict=True))  # type: ignore[return-value]
