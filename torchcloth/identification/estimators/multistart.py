"""Several starting points of a search, so that the answer does not depend on one of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ...episodes.unknowns import LOG_DECADE, Unknown
from . import levenberg_marquardt

START_RANGE_DECADES = 1.0  # to either side, of a positive parameter; prior standard deviations of any other
MAX_AGREEMENT_STD_ERRORS = 1.0  # distance within which two end points are one answer


class MultistartResult(NamedTuple):
    """What several starts led to.

    Attributes:
        raw: [K] the best end point.
        agreeing: number of starts that led there, within a standard error in every direction.
        simulated: number of starts that could be simulated.
    """

    raw: Tensor
    agreeing: int
    simulated: int


def sample_starts(unknowns: Sequence[Unknown], start: Tensor, count: int) -> list[Tensor]:
    """Return ``count`` starts [K]: the given one, then points spread evenly over every unknown's range (Sobol)."""
    if count == 1:
        return [start]
    points = torch.quasirandom.SobolEngine(len(unknowns), scramble=True, seed=0).draw(count - 1, dtype=torch.float64)
    starts = [start]
    for point in points:
        raw = start.clone()
        for k, unknown in enumerate(unknowns):
            half_range = 0.0 if unknown.measured else _half_range(unknown)
            raw[k] = unknown.clip(float(start[k] + half_range * (2 * point[k] - 1)))
        starts.append(raw)
    return starts


def _half_range(unknown: Unknown) -> float:
    if unknown.parameter.domain == "positive":
        return START_RANGE_DECADES * LOG_DECADE
    return START_RANGE_DECADES * unknown.prior_std


def comparable_costs(
    problem: levenberg_marquardt.Problem, points: Sequence[levenberg_marquardt.Iterate]
) -> list[float]:
    """Return the robust costs of points with the same noise scales for all."""
    reference = min(points, key=lambda at: float(at.scale.log().sum()))  # smallest noise: it explains most
    return [levenberg_marquardt.robust_cost(problem, reference, at.raw, at.linear.residual) for at in points]


def select_best(problem: levenberg_marquardt.Problem, ends: Sequence[levenberg_marquardt.Iterate]) -> MultistartResult:
    """Return the end point of least robust cost, and how many others agree with it."""
    costs = comparable_costs(problem, ends)
    best = ends[costs.index(min(costs))]
    # chaos leaves the covariance singular
    precision = torch.linalg.pinv(levenberg_marquardt.covariance(problem, best), hermitian=True)
    offsets = [at.raw - best.raw for at in ends]
    distances = [max(float(offset @ precision @ offset), 0.0) ** 0.5 for offset in offsets]
    return MultistartResult(best.raw, sum(d <= MAX_AGREEMENT_STD_ERRORS for d in distances), len(ends))
