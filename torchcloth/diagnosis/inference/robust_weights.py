"""Stretches of time in which the simulation goes another way count for less.

Cloth that folds over, or ripples on the other side, is millimetres off until it comes back, and nothing smooth mends
it. So what a model leaves is taken for noise of a level that differs from stretch to stretch: whitened, the n cells of
a stretch follow a multivariate t-distribution, whose maximum solves least squares with weights

    w = min(1, (FREEDOM + n) / (FREEDOM + Q)),   Q = sum of squares in the stretch

(Lange, Little and Taylor 1989; a stretch that fits well counts as ever).
"""

from __future__ import annotations

import torch
from torch import Tensor

from .noise import WhitenedBins

FREEDOM = 5.0  # degrees


def reweight(white: WhitenedBins, step: Tensor | None = None) -> WhitenedBins:
    """Cells weighted by stretch, and by nothing else: as they are, or after a ``step`` of the first coordinates."""
    plain = remove_weights(white)
    value = plain.value if step is None else plain.value + plain.jacobian[:, : len(step)] @ step
    share = t_weights(value, plain.time_block).sqrt()
    return plain._replace(value=share * plain.value, jacobian=share[:, None] * plain.jacobian, share=share)


def remove_weights(white: WhitenedBins) -> WhitenedBins:
    """Cells as whitening left them."""
    value, slopes = white.value / white.row_weight, white.jacobian / white.row_weight[:, None]
    return white._replace(value=value, jacobian=slopes, share=torch.ones_like(value))


def t_weights(value: Tensor, stretch: Tensor) -> Tensor:
    """[C] of whitened cells."""
    count, square = _sums(value, stretch)
    return ((FREEDOM + count) / (FREEDOM + square)).clamp(max=1.0)[stretch]


def t_log_density(value: Tensor, stretch: Tensor) -> Tensor:
    """[stretches] logarithms, up to a constant that depends on the number of cells alone."""
    count, square = _sums(value, stretch)
    return -0.5 * (FREEDOM + count) * torch.log1p(square / FREEDOM)


def _sums(value: Tensor, stretch: Tensor) -> tuple[Tensor, Tensor]:
    zeros = value.new_zeros(int(stretch.max()) + 1)
    return zeros.index_add(0, stretch, torch.ones_like(value)), zeros.index_add(0, stretch, value.square())
