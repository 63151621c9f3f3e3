"""Check that the positions at the first frame are those of the mesh, vertex by vertex."""

from __future__ import annotations

import numpy as np

from ..errors import RecordingError
from .types import ClothInfo

MAX_EDGE_RATIO = 2.0  # length of an edge over its rest length; no cloth stretches more where it hangs at rest
MIN_EDGE_EXCESS = 0.05  # of the cloth's size, by which such an edge is too long; less may be noise on a fine mesh
MAX_LONG_EDGE_FRACTION = 0.01  # of the edges; a few may belong to vertices that were measured wrongly


def check_initial_shape(cloth: ClothInfo, place: str) -> None:
    """Refuse initial vertices in another order than the mesh's, or a grid of them in another order than the sheet's.

    Args:
        cloth: with or without initial vertices.
        place: of them, for messages.

    Raises:
        RecordingError: more than 1 % of the edges are far longer than at rest.
    """
    initial = cloth.initial_vertices
    if initial is None:
        return
    if initial.ndim == 3 and cloth.sheet is not None:
        spacing = np.array(cloth.sheet) / (np.array(initial.shape[:2]) - 1)
        sides = [np.linalg.norm(np.diff(initial, axis=axis), axis=-1).ravel() for axis in (0, 1)]
        rest = np.concatenate([np.full(len(side), space) for side, space in zip(sides, spacing, strict=True)])
        _check_edge_lengths(np.concatenate(sides), rest, float(np.hypot(*cloth.sheet)), place)
    elif cloth.vertices is not None and cloth.faces is not None and len(initial) == len(cloth.vertices):
        rest = _edge_lengths(cloth.vertices[cloth.faces])
        if cloth.uv is not None:  # the mesh at rest may lie folded
            rest = np.maximum(rest, _edge_lengths(cloth.uv[cloth.faces] if cloth.uv.ndim == 2 else cloth.uv))
        _check_edge_lengths(_edge_lengths(initial[cloth.faces]), rest, float(np.sqrt((rest**2).sum() / 3)), place)


def _check_edge_lengths(now: np.ndarray, rest: np.ndarray, size: float, place: str) -> None:
    """Refuse edges [E] m that are far longer than at rest, on a cloth of this size [m]."""
    too_long = (now > MAX_EDGE_RATIO * rest) & (now - rest > MIN_EDGE_EXCESS * size)
    if too_long.mean() > MAX_LONG_EDGE_FRACTION:
        ratio = float((now[too_long] / np.maximum(rest[too_long], np.finfo(float).tiny)).max())
        raise RecordingError(
            f"{place} is not a shape of this mesh",
            got=f"edges up to {ratio:.2g} times their rest length",
            expected="one position for each vertex, in the order of the mesh",
            remedy="were vertices reordered? Load both without merging or sorting vertices",
        )


def _edge_lengths(corners: np.ndarray) -> np.ndarray:
    """Lengths [3 F] m of the sides of triangles [F, 3, D]."""
    return np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).ravel()
