"""Where a search begins: from several places, so that no answer is that of its start."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ...episodes.unknowns import DECADE, Unknown
from . import levenberg_marquardt

REACH = 1.0  # decades to either side, of a positive parameter; standard deviations of the prior for others
SAME = 1.0  # standard error within which two answers are one


class Reached(NamedTuple):
    """What came of several starts."""

    raw: Tensor  # the best
    agree: int  # starts that led there, within a standard error in every direction
    tried: int  # starts that could be simulated


def spread(unknowns: Sequence[Unknown], start: Tensor, count: int) -> list[Tensor]:
    """``count`` starts [K], the given one first, the others evenly over the range of every unknown (Sobol)."""
    if count == 1:
        return [start]
    share = torch.quasirandom.SobolEngine(len(unknowns), scramble=True, seed=0).draw(count - 1, dtype=torch.float64)
    out = [start]
    for row in share:
        raw = start.clone()
        for k, unknown in enumerate(unknowns):
            width = 0.0 if unknown.measured else _width(unknown)
            raw[k] = unknown.clip(float(start[k] + width * (2 * row[k] - 1)))
        out.append(raw)
    return out


def _width(unknown: Unknown) -> float:
    if unknown.parameter.domain == "positive":
        return REACH * DECADE
    return REACH * unknown.prior_std


def best(problem: levenberg_marquardt.Problem, found: Sequence[levenberg_marquardt.Iterate]) -> Reached:
    """The end point of least robust cost, measured by the same scales for all."""
    judge = min(found, key=lambda at: float(at.scale.log().sum()))  # explains most: its noise is the smallest
    costs = [levenberg_marquardt.cost(problem, judge, at.raw, at.linear.value) for at in found]
    winner = found[costs.index(min(costs))]
    hessian = torch.linalg.pinv(
        levenberg_marquardt.covariance(problem, winner), hermitian=True
    )  # chaos leaves it singular
    away = [max(float((at.raw - winner.raw) @ hessian @ (at.raw - winner.raw)), 0.0) ** 0.5 for at in found]
    return Reached(winner.raw, sum(d <= SAME for d in away), len(found))
