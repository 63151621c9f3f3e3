"""What a lasting misfit can do to the estimates.

Noise of a sensor averages out over points and frames. The error of a wrong model does not, nor does a slow error of a
camera: over a part of the fabric it lasts from frame to frame, and it may grow and shrink just as the cloth would if a
parameter were another one. Residuals show how large it is: what the mean of a part has in common in neighbouring frames
is no noise of single readings. Its time course is unknown, so the worst is assumed within a part of the fabric and an
episode; different parts are taken as independent.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ..estimators import levenberg_marquardt
from ..estimators.levenberg_marquardt import Iterate, Problem


class ResidualSplit(NamedTuple):
    """Mean squares of the residuals of every block, in the block's unit squared.

    Attributes:
        total: [B] of the residuals that count.
        lasting: [B] of what parts of the fabric have in common in neighbouring frames, at most ``total``.
    """

    total: Tensor
    lasting: Tensor


def split_residuals(at: Iterate, episode: Tensor) -> ResidualSplit:
    """Estimate how much of the residuals lasts from frame to frame.

    The products of the means of neighbouring frames have the variance of the lasting part as their mean, whatever the
    noise of single readings.

    Args:
        at: the solution.
        episode: [R] number of the episode of every row.
    """
    linear = at.linear
    counts = (at.row_weights()[0] > 0) & (linear.residual != 0)  # no outlier, and nothing that was not observed
    total, lasting = linear.residual.new_zeros(2, len(at.scale))
    for b in range(len(at.scale)):
        rows = ((linear.blocks == b) & counts).nonzero().squeeze(-1)
        if not len(rows):
            continue
        residual = linear.residual[rows]
        total[b] = residual.square().mean()
        part, frames = _number(linear.error_group[rows], episode[rows]), _number(linear.frame[rows])
        shape = int(part.max()) + 1, int(frames.max()) + 1
        index = part * shape[1] + frames
        summed, count = residual.new_zeros(2, shape[0] * shape[1]).index_add(
            1, index, torch.stack([residual, torch.ones_like(residual)])
        )
        mean, count = (summed / count.clamp(min=1)).reshape(shape), count.reshape(shape)
        pairs = torch.minimum(count[:, 1:], count[:, :-1])
        if float(pairs.sum()) > 0:
            lasting[b] = ((pairs * mean[:, 1:] * mean[:, :-1]).sum() / pairs.sum()).clamp(0.0, float(total[b]))
        else:
            lasting[b] = total[b]  # a single frame shows no difference
    return ResidualSplit(total, lasting)


def misfit_variance(problem: Problem, at: Iterate, episode: Tensor, lasting: Tensor) -> Tensor:
    """Compute the variances [K] of the estimate by a lasting misfit of the worst time course.

    Args:
        problem: the residuals and the prior.
        at: the solution.
        episode: [R] number of the episode of every row.
        lasting: [B] mean square of the lasting misfit.
    """
    linear = at.linear
    weighted = at.row_weights()[0][:, None] * linear.jacobian
    gain = torch.linalg.solve(levenberg_marquardt.information_matrix(problem, at), weighted.mT).abs()
    part = _number(linear.blocks, linear.error_group, episode)
    size = lasting.sqrt()[linear.blocks]
    summed = gain.new_zeros(len(gain), int(part.max()) + 1).index_add(1, part, gain * size)
    return summed.square().sum(1)


def _number(*labels: Tensor) -> Tensor:
    """[R] int64, numbers from 0 of the combinations of labels that occur."""
    return torch.unique(torch.stack(labels), dim=1, return_inverse=True)[1]
