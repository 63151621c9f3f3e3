"""Nearest triangles by the compiled library; ``losses`` searches in torch where this returns None."""

from __future__ import annotations

import torch
from torch import Tensor

from .library import library_if_built

_SUFFIXES = {torch.float32: "f", torch.float64: "d"}


def find_nearest_triangles_compiled(points: Tensor, corners: Tensor) -> tuple[Tensor, Tensor] | None:
    """Find the nearest triangle of each point, by the compiled library.

    Args:
        points: [N, 3] m.
        corners: [F, 3, 3] m, corners of the triangles.

    Returns:
        The triangles [N], the first of several equally near, and barycentric coordinates [N, 3] of the nearest places.
        None where the library is not built, does not take such tensors, or a number is not finite.
    """
    suffix = _SUFFIXES.get(points.dtype)
    if suffix is None or corners.dtype != points.dtype or points.device.type != "cpu" or corners.device.type != "cpu":
        return None
    if (library := library_if_built()) is None:
        return None
    points, corners = points.contiguous(), corners.contiguous()
    triangle, weights = torch.empty(len(points), dtype=torch.int64), torch.empty_like(points)
    try:
        inputs, outputs = (points.data_ptr(), corners.data_ptr()), (triangle.data_ptr(), weights.data_ptr())
    except RuntimeError:  # tensors of torch.func have no memory
        return None
    failed = getattr(library, f"tc_nearest_{suffix}")(inputs[0], len(points), inputs[1], len(corners), *outputs)
    is_finite = bool(points.isfinite().all() & corners.isfinite().all())  # the library skips triangles that are not
    return (triangle, weights) if is_finite and not failed and bool((triangle >= 0).all()) else None
