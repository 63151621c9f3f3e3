"""Small vector algebra with finite derivatives at the states that occur (flat, at rest, zero friction)."""

from __future__ import annotations

import torch
from torch import Tensor


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Inner product over the last axis, kept: [..., 3], [..., 3] -> [..., 1]."""
    return (a * b).sum(-1, keepdim=True)


def cross(a: Tensor, b: Tensor) -> Tensor:
    """Vector product over the last axis: [..., 3], [..., 3] -> [..., 3]."""
    return torch.linalg.cross(a, b)


def safe_norm(a: Tensor) -> Tensor:
    """Length over the last axis, kept; value and derivative 0 at a = 0 (the plain square root gives NaN there)."""
    squared = dot(a, a)
    zero = squared == 0
    return torch.where(zero, torch.zeros_like(squared), torch.where(zero, 1.0, squared).sqrt())
