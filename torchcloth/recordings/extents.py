"""How large a cloth is, and how large what was seen of it."""

from __future__ import annotations

import numpy as np

from .types import ClothInfo


def longest(cloud: np.ndarray) -> float:
    """Largest width of a cloud, m, over many directions: its diameter to 2 %."""
    if len(cloud) == 0:
        return 0.0
    turn, height = np.meshgrid(np.arange(24) * np.pi / 12, np.linspace(0, 1, 8))
    flat = np.sqrt(1 - height**2)
    directions = np.stack([flat * np.cos(turn), flat * np.sin(turn), height], -1).reshape(-1, 3)
    return float(np.ptp(cloud @ directions.T, axis=0).max())


def size(cloth: ClothInfo) -> tuple[float | None, float | None]:
    """Longest distance on the cloth, m, and its area, m^2."""
    if cloth.vertices is not None and cloth.faces is not None:
        a, b, c = (cloth.vertices[cloth.faces[:, k]] for k in range(3))
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
        return float(np.linalg.norm(np.ptp(cloth.vertices, axis=0))), float(area)
    if cloth.sheet is not None:
        return float(np.hypot(*cloth.sheet)), float(np.prod(cloth.sheet))
    return None, None
