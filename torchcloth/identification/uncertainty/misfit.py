"""What a misfit can do to the estimates.

Noise of a sensor averages out over points and frames. The error of a wrong model does not, nor does a slow error of a
camera or a wrong stamp: all readings of a part of the fabric share it, and it may grow and shrink just as the cloth
would if a parameter were another one. Residuals show how large it is: what readings of a part have in common, in one
frame or in neighbouring ones, is no noise of single readings. Its time course is unknown, so the worst is assumed
within a part of the fabric and an episode; different parts are taken as independent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from ...inspection.noise import estimate_cloud_noise
from ...recordings import Recording
from ..estimators import levenberg_marquardt
from ..estimators.levenberg_marquardt import Iterate, Problem


@dataclass(frozen=True)
class MisfitCriteria:
    """When a fit means nothing, because it is far from the data.

    Attributes:
        max_misfit_over_noise: shared misfit of the points over their noise. Rigs without a fault end at 1 to 2, a
            camera that is 5 mm off at 2.6, a hinged grip at 6, stamps with 34 ms of jitter at 5, and a model without
            air at 3 to 10 (``studies honesty``, seeds 1000 to 1011). A hinge with a misfit of 2.6 ended at 0.42 ± 0.08
            of the true stiffness (seed 8).
        min_noise_m: least noise [m] for this comparison: no model of cloth is better than that.
        max_chamfer_over_start: distance of the fit over that of the start.
    """

    max_misfit_over_noise: float = 2.5
    min_noise_m: float = 1e-3
    max_chamfer_over_start: float = 1.1


MISFIT_CRITERIA = MisfitCriteria()


class ResidualSplit(NamedTuple):
    """Mean squares of the residuals of every block, in the block's unit squared.

    Attributes:
        total: [B] of the residuals that count.
        shared: [B] of what the readings of a part of the fabric have in common, at most ``total``.
    """

    total: Tensor
    shared: Tensor


def split_residuals(at: Iterate, episode: Tensor) -> ResidualSplit:
    """Estimate how much of the residuals the readings of a part of the fabric share.

    Products of two readings of a part in one frame, or of its means in neighbouring frames, have the variance of the
    shared error as their mean, whatever the noise of single readings. The larger one counts: the first sees wrong
    stamps of single frames, which the second does not, and the second needs no two readings of a part in a frame.

    Args:
        at: the solution.
        episode: [R] number of the episode of every row.
    """
    linear = at.linear
    counts = (at.row_weights()[0] > 0) & (linear.residual != 0)  # no outlier, and nothing that was not observed
    total, shared = linear.residual.new_zeros(2, len(at.scale))
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
        squares = torch.zeros_like(summed).index_add(0, index, residual.square())
        same_frame = float((summed.square() - squares).sum()), float((count * (count - 1)).sum())
        mean, count = (summed / count.clamp(min=1)).reshape(shape), count.reshape(shape)
        pairs = torch.minimum(count[:, 1:], count[:, :-1])
        neighbours = float((pairs * mean[:, 1:] * mean[:, :-1]).sum()), float(pairs.sum())
        mean_products = [total_product / number for total_product, number in (same_frame, neighbours) if number > 0]
        shared[b] = total[b] if neighbours[1] == 0 else min(max(0.0, *mean_products), float(total[b]))
    return ResidualSplit(total, shared)


def misfit_variance(problem: Problem, at: Iterate, episode: Tensor, shared: Tensor) -> Tensor:
    """Compute the variances [K] of the estimate by a shared misfit of the worst time course.

    Args:
        problem: the residuals and the prior.
        at: the solution.
        episode: [R] number of the episode of every row.
        shared: [B] mean square of the shared misfit.
    """
    linear = at.linear
    weighted = at.row_weights()[0][:, None] * linear.jacobian
    gain = torch.linalg.solve(levenberg_marquardt.information_matrix(problem, at), weighted.mT).abs()
    part = _number(linear.blocks, linear.error_group, episode)
    size = shared.sqrt()[linear.blocks]
    summed = gain.new_zeros(len(gain), int(part.max()) + 1).index_add(1, part, gain * size)
    return summed.square().sum(1)


def estimate_point_noise(recordings: Sequence[Recording]) -> float:
    """Return the standard deviation of the points [m], the largest of all recordings; 0 where there are none.

    It is what a recording states, or what the scatter about local surfaces shows if that is more.
    """
    stds = [0.0]
    for recording in recordings:
        estimate = None if recording.points is None else estimate_cloud_noise(recording.points, None)
        stds += [recording.observation_noise_std or 0.0, 0.0 if estimate is None else estimate.std]
    return max(stds)


def find_misfit(
    misfit: float, noise: float, chamfer_over_start: float = 0.0, criteria: MisfitCriteria = MISFIT_CRITERIA
) -> str:
    """Return why a fit describes its data too badly to say anything; empty where it does not.

    Args:
        misfit: shared misfit of the points [m].
        noise: of the points [m].
        chamfer_over_start: distance from the points, over that of the start values.
        criteria: the limits.
    """
    if misfit > criteria.max_misfit_over_noise * max(noise, criteria.min_noise_m):
        return (
            f"the model does not describe these data: whole parts of the fabric are {1e3 * misfit:.1f} mm off "
            f"(rms), and the points have a noise of {1e3 * noise:.2g} mm; no parameter counts as identified"
        )
    if chamfer_over_start > criteria.max_chamfer_over_start:
        return "the search ended farther from the points than it began; no parameter counts as identified"
    return ""


def _number(*labels: Tensor) -> Tensor:
    """[R] int64, numbers from 0 of the combinations of labels that occur."""
    return torch.unique(torch.stack(labels), dim=1, return_inverse=True)[1]
