"""Checks of points and triangles: a wrong shape would reach the compiled search as a wrong length."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ..errors import InvalidInput


def as_tensor(given: Tensor | np.ndarray) -> Tensor:
    """Return a tensor as it is, and an array of recordings or meshes as a tensor."""
    return given if isinstance(given, Tensor) else torch.as_tensor(given)


def check_points(places: Tensor, name: str, min_count: int = 0) -> None:
    """Check that ``places`` are [N, 3] real numbers with N >= ``min_count``.

    Raises:
        InvalidInput: anything else.
    """
    if places.ndim != 2 or places.shape[1] != 3 or len(places) < min_count:
        expected = "[N, 3] in metres" + (f", N >= {min_count}" if min_count else "")
        raise InvalidInput(name, got=f"shape {tuple(places.shape)}", expected=expected, remedy="pass one frame at once")
    if not places.is_floating_point():
        raise InvalidInput(name, got=str(places.dtype).removeprefix("torch."), expected="real numbers, in metres")


def check_triangles(faces: Tensor, count: int) -> None:
    """Check that ``faces`` are [F, 3] indices below ``count``, F > 0.

    Raises:
        InvalidInput: anything else.
    """
    if faces.ndim != 2 or faces.shape[1] != 3 or len(faces) == 0 or faces.dtype not in (torch.int32, torch.int64):
        got = f"shape {tuple(faces.shape)} of {faces.dtype}"
        raise InvalidInput("faces", got=got, expected="[F, 3] int64, F > 0")
    low, high = (int(end) for end in faces.aminmax())
    if low < 0 or high >= count:
        got = f"indices {low} to {high}"
        raise InvalidInput("faces", got=got, expected=f"indices of the {count} vertices", remedy="pass the mesh's own")
