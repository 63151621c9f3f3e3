"""Dahl's law of internal friction: z' = s (k' - |k'| z / Z), from sticking with stiffness s to sliding at Z."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from .._utils.linalg import safe_norm
from ..errors import InvalidInput


def update_dahl_fraction(fraction: Tensor, change: Tensor, threshold: float) -> Tensor:
    """Return the fraction z / Z [..., K] of the sliding friction after a straight change of strain [..., K].

    The integration is exact, so the result depends on the path and not on steps or time. Friction opposes motion as a
    vector: for K > 1 its length never exceeds 1, in any direction.
    """
    path = change / threshold
    length = safe_norm(path)
    return fraction * torch.exp(-length) + path * _mean_decay(length)


def check_threshold(value: float, name: str, unit: str) -> float:
    """Return the strain over which friction builds up, Z / s, if it is valid.

    Raises:
        InvalidInput: unless it is positive.
    """
    if not 0 < value < math.inf:
        raise InvalidInput(f"{name} threshold", got=f"{value} {unit}", expected="a value > 0")
    return float(value)


def _mean_decay(length: Tensor) -> Tensor:
    """Return (1 - exp(-y)) / y, with finite derivatives at y = 0."""
    small = length < 1e-4
    safe = torch.where(small, 1.0, length)
    return torch.where(small, 1 - length / 2 + length**2 / 6, -torch.expm1(-safe) / safe)
