"""Robust weights of time blocks: blocks in which the simulation diverges from the recording count for less.

Cloth that folds over, or ripples to the other side, is off by millimetres until it comes back, and no smooth change of
the model explains it. So the whitened n bins of a time block follow a multivariate t distribution with f degrees of
freedom, and their maximum likelihood solves least squares with weights

    w = min(1, (f + n) / (f + Q)),   Q = sum of squares in the block

(Lange, Little and Taylor 1989). A block that fits well has weight 1.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ..decide.criteria import CRITERIA
from .noise import WhitenedBins


def reweight(whitened: WhitenedBins, step: Tensor | None = None) -> WhitenedBins:
    """Replace the weights of all bins by those of their residuals.

    Args:
        whitened: bins with any weights.
        step: step of the first coordinates after which the residuals are taken; None: residuals as they are.
    """
    plain = remove_weights(whitened)
    value = plain.value if step is None else plain.value + plain.jacobian[:, : len(step)] @ step
    root = t_weights(value, plain.time_block).sqrt()
    return plain._replace(value=root * plain.value, jacobian=root[:, None] * plain.jacobian, row_weight=root)


def remove_weights(whitened: WhitenedBins) -> WhitenedBins:
    """Return the bins as whitening left them."""
    value, slopes = whitened.value / whitened.row_weight, whitened.jacobian / whitened.row_weight[:, None]
    return whitened._replace(value=value, jacobian=slopes, row_weight=torch.ones_like(value))


def t_weights(value: Tensor, time_block: Tensor) -> Tensor:
    """Return [B] the weights of whitened residuals ``value`` [B] in their time blocks [B]."""
    t_dof = CRITERIA.robust.t_dof
    count, square = _block_sums(value, time_block)
    return ((t_dof + count) / (t_dof + square)).clamp(max=1.0)[time_block]


def t_log_density(value: Tensor, time_block: Tensor) -> Tensor:
    """Return [blocks] log densities, up to a constant that depends on the number of bins alone."""
    t_dof = CRITERIA.robust.t_dof
    count, square = _block_sums(value, time_block)
    return -0.5 * (t_dof + count) * torch.log1p(square / t_dof)


def _block_sums(value: Tensor, time_block: Tensor) -> tuple[Tensor, Tensor]:
    zeros = value.new_zeros(int(time_block.max()) + 1)
    return zeros.index_add(0, time_block, torch.ones_like(value)), zeros.index_add(0, time_block, value.square())
