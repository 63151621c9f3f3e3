"""Drift of forces that is common to all motions: too small to be seen in one motion, and significant in all.

The rate c of a force c t, from each episode's start on, is in one episode

    c_k = d' K^-1 r / d' K^-1 d,  variance 1 / d' K^-1 d,

with the covariance K of a correct model (``lack_of_fit.expected_covariance``), which includes tares, and the time d of
the force's bins. Motions are pooled with their scatter beyond that (DerSimonian and Laird 1986), because what depends
on the motion is no drift. The scatter of a few motions is not well known, so the mean has Student's distribution, with
the degrees of freedom of its variance (Satterthwaite 1946).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from scipy.special import stdtr
from torch import Tensor

from ..data.binning import FORCE_BLOCK, BinnedResiduals
from ..decide.criteria import CRITERIA
from .fitting import ModelFit
from .lack_of_fit import do_meshes_agree, expected_covariance

AXES = "xyz"
MIN_SCATTER_FRACTION = 1e-6  # of the mean's variance, so that its degrees of freedom stay finite


class ForceDrift(NamedTuple):
    """Drift of the forces on all grippers, measured less simulated, along one axis of the world.

    Attributes:
        axis: "x", "y" or "z".
        rate: mean over motions [N/s].
        std: its standard error [N/s].
        p_value: probability that a correct model drifts as much along any axis.
    """

    axis: str
    rate: float
    std: float
    p_value: float

    @property
    def is_significant(self) -> bool:
        """Whether a correct model hardly ever drifts as much."""
        return self.p_value < CRITERIA.adequacy.max_p_value

    def as_dict(self) -> dict[str, Any]:
        """Return the row of diagnosis.json."""
        return {**self._asdict(), "unit": "N/s", "is_significant": self.is_significant}


def estimate_force_drifts(fitted: ModelFit, motions: Sequence[str]) -> list[ForceDrift]:
    """Estimate the drift along each axis; an empty list if fewer than four motions have such forces.

    Args:
        fitted: a model at its solution.
        motions: label of each episode.
    """
    min_motions = CRITERIA.adequacy.min_drift_motions
    by_motion: dict[str, list[tuple[Tensor, Tensor]]] = {}
    for k, (motion, bins) in enumerate(zip(motions, fitted.linearisation.bins, strict=True)):
        if _has_later_forces(bins) and do_meshes_agree(fitted, k):
            by_motion.setdefault(motion, []).append(_estimate_rates(fitted, k))
    if len(by_motion) < min_motions:
        return []
    pooled = map(_pool_repetitions, by_motion.values())
    rates, informations = (torch.stack(column) for column in zip(*pooled, strict=True))
    drifts = []
    for axis, rate, information in zip(AXES, rates.mT, informations.mT, strict=True):
        is_informed = information > 0  # bins of one axis may all be left out
        if int(is_informed.sum()) < min_motions:
            continue
        mean, std, dof = _pool_motions(rate[is_informed], 1 / information[is_informed])
        p_value = 2 * float(stdtr(dof, -abs(mean) / std))
        drifts.append(ForceDrift(axis, mean, std, min(1.0, len(AXES) * p_value)))
    return drifts


def _has_later_forces(bins: BinnedResiduals) -> bool:
    return len(bins.time) > 0 and bool(((bins.block == FORCE_BLOCK) & (bins.time > bins.time.min())).any())


def _pool_repetitions(repetitions: Sequence[tuple[Tensor, Tensor]]) -> tuple[Tensor, Tensor]:
    """Return (rates, informations) [axes] of one motion, whose repetitions share the model's error there."""
    total = torch.stack([information for _, information in repetitions]).sum(0)
    return torch.stack([information * rate for rate, information in repetitions]).sum(0) / _one_if_zero(total), total


def _one_if_zero(information: Tensor) -> Tensor:
    return torch.where(information > 0, information, 1.0)


def _estimate_rates(fitted: ModelFit, k: int) -> tuple[Tensor, Tensor]:
    """Return (rates, informations) [axes] of one episode; an information is an inverse variance."""
    bins = fitted.linearisation.bins[k]
    axis = torch.arange(len(AXES))
    is_force = (bins.block == FORCE_BLOCK)[:, None] & (bins.channel[:, None] % 3 == axis)
    elapsed = torch.where(is_force, (bins.time - bins.time.min())[:, None], 0.0)
    noise_covariance, uncertain = expected_covariance(fitted, k)
    solved = torch.linalg.solve(noise_covariance + uncertain @ uncertain.mT, elapsed)
    information = (solved * elapsed).sum(0)
    return solved.mT @ bins.value / _one_if_zero(information), information


def _pool_motions(rate: Tensor, variance: Tensor) -> tuple[float, float, float]:
    """Return (mean, standard error, degrees of freedom) by within-motion variance and between-motion scatter."""
    precision = 1 / variance
    excess = (precision * (rate - (precision @ rate) / precision.sum()) ** 2).sum() - (len(rate) - 1)
    between = float(excess / (precision.sum() - precision.square().sum() / precision.sum()))
    weight = 1 / (variance + max(0.0, between))
    scatter_fraction = max(1 - float(weight.sum() / precision.sum()), MIN_SCATTER_FRACTION)
    mean, std = float(weight @ rate / weight.sum()), float(weight.sum().rsqrt())
    return mean, std, (len(rate) - 1) / scatter_fraction**2
