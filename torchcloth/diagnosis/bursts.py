"""Stretches of time in which the simulation goes another way count for less.

Cloth that folds over, or ripples on the other side, is millimetres off until it comes back, and nothing smooth mends
it. So what a model leaves is taken for noise of a level that differs from stretch to stretch: whitened, the n cells of
a stretch follow a multivariate t-distribution, whose maximum solves least squares with weights

    w = min(1, (FREEDOM + n) / (FREEDOM + Q)),   Q = sum of squares in the stretch

(Lange, Little and Taylor 1989; a stretch that fits well counts as ever).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from .cells import Cells
from .evidence import Evidence
from .noise import Noise, Whitened, whitened

FREEDOM = 5.0  # degrees


def calmed(evidence: Evidence, noise: Noise) -> Whitened:
    """All episodes' cells, whitened and weighted by stretch."""
    white = whitened(evidence, noise)
    share = weights(white.value, stretches(evidence.cells)).sqrt()
    return white._replace(value=share * white.value, jacobian=share[:, None] * white.jacobian, share=share)


def stretches(cells: Sequence[Cells]) -> Tensor:
    """[C] numbers that cells of one episode, kind of data and window share."""
    own = [torch.stack([torch.full_like(c.window, k), c.block, c.window], 1) for k, c in enumerate(cells)]
    return torch.cat(own).unique(dim=0, return_inverse=True)[1]


def weights(value: Tensor, stretch: Tensor) -> Tensor:
    """[C] of whitened cells."""
    count, square = _sums(value, stretch)
    return ((FREEDOM + count) / (FREEDOM + square)).clamp(max=1.0)[stretch]


def densities(value: Tensor, stretch: Tensor) -> Tensor:
    """[stretches] logarithms, up to a constant that depends on the number of cells alone."""
    count, square = _sums(value, stretch)
    return -0.5 * (FREEDOM + count) * torch.log1p(square / FREEDOM)


def _sums(value: Tensor, stretch: Tensor) -> tuple[Tensor, Tensor]:
    zeros = value.new_zeros(int(stretch.max()) + 1)
    return zeros.index_add(0, stretch, torch.ones_like(value)), zeros.index_add(0, stretch, value.square())
