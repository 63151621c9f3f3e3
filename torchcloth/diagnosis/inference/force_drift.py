"""Forces that grow with time in all motions alike: too little to be seen in one of them, and no chance in all.

The rate c of a force c t, from each episode's start on, is in one episode

    c_k = d' K^-1 r / d' K^-1 d,  variance 1 / d' K^-1 d,

with K what a right model leaves (``lacking.right``), which knows of tares, and d the time of the cells of that force.
Motions are pooled with what they differ by beyond that (DerSimonian and Laird 1986): what depends on the motion is no
drift. What few of them differ by is not well known, so the mean has Student's distribution, with as many degrees of
freedom as its variance has (Satterthwaite 1946).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..data.binning import FORCE_BLOCK
from .fitting import ModelFit
from .lack_of_fit import RARE, expected_covariance, do_meshes_agree

FEWEST = 4  # motions that can be alike
AXES = "xyz"


class ForceDrift(NamedTuple):
    """Of the forces on all grippers, measured less simulated, along one axis of the world."""

    axis: str
    rate: float  # N/s
    std: float
    p_value: float  # of a right model's drifting as much along any axis

    @property
    def is_significant(self) -> bool:
        """No chance."""
        return self.p_value < RARE

    def as_dict(self) -> dict[str, Any]:
        """As diagnosis.json has it."""
        return {**self._asdict(), "unit": "N/s", "lacking": self.is_significant}


def estimate_force_drifts(found: ModelFit, names: Sequence[str]) -> list[ForceDrift]:
    """One for each axis; none where fewer than four of the motions ``names`` have such forces and can be judged."""
    later = lambda c: len(c.time) and bool(((c.block == FORCE_BLOCK) & (c.time > c.time.min())).any())  # noqa: E731
    every: dict[str, list[tuple[Tensor, Tensor]]] = {}
    for k, (name, cells) in enumerate(zip(names, found.linearisation.bins, strict=True)):
        if later(cells) and do_meshes_agree(found, k):
            every.setdefault(name, []).append(_rates(found, k))
    if len(every) < FEWEST:
        return []
    rates, known = (torch.stack(column) for column in zip(*map(_together, every.values()), strict=True))
    rows = []
    for axis, rate, information in zip(AXES, rates.mT, known.mT, strict=True):
        tells = information > 0  # cells of one axis may all jump
        if int(tells.sum()) < FEWEST:
            continue
        mean, std, freedom = _pooled(rate[tells], 1 / information[tells])
        rows.append(ForceDrift(axis, mean, std, min(1.0, len(AXES) * _beyond(abs(mean) / std, freedom))))
    return rows


def _together(repeats: Sequence[tuple[Tensor, Tensor]]) -> tuple[Tensor, Tensor]:
    """(rates, information) [axes] of one motion: repetitions of it share whatever the model gets wrong there."""
    total = torch.stack([known for _, known in repeats]).sum(0)
    return torch.stack([known * rate for rate, known in repeats]).sum(0) / _or_one(total), total


def _or_one(information: Tensor) -> Tensor:
    return torch.where(information > 0, information, 1.0)


def _rates(found: ModelFit, k: int) -> tuple[Tensor, Tensor]:
    """(rates, information: inverse variances) [axes] of one episode with forces in more than one window."""
    cells = found.linearisation.bins[k]
    axis = torch.arange(len(AXES))
    here = (cells.block == FORCE_BLOCK)[:, None] & (cells.channel[:, None] % 3 == axis)
    since = torch.where(here, (cells.time - cells.time.min())[:, None], 0.0)
    still, moved = expected_covariance(found, k)
    weighed = torch.linalg.solve(still + moved @ moved.mT, since)
    information = (weighed * since).sum(0)
    return weighed.mT @ cells.value / _or_one(information), information


def _pooled(rate: Tensor, variance: Tensor) -> tuple[float, float, float]:
    """(mean, standard error, its degrees of freedom) by what motions are known to and what they differ by."""
    known = 1 / variance
    over = (known * (rate - (known @ rate) / known.sum()) ** 2).sum() - (len(rate) - 1)
    between = float(over / (known.sum() - known.square().sum() / known.sum()))
    weight = 1 / (variance + max(0.0, between))
    share = max(1 - float(weight.sum() / known.sum()), 1e-6)  # of the mean's variance, by what motions differ by
    return float(weight @ rate / weight.sum()), float(weight.sum().rsqrt()), (len(rate) - 1) / share**2


def _beyond(size: float, freedom: float) -> float:
    """Chance that Student's t is farther from zero than this: with t = sqrt(n) tan(a), the integral of cos(a)^(n-1)."""
    if freedom > 1e3:
        return math.erfc(size / 2**0.5)
    start, quarter = math.atan(size / freedom**0.5), 0.5 * math.pi
    tail, whole = (torch.linspace(a, quarter, 10_001, dtype=torch.float64) for a in (start, 0.0))
    area = lambda angle: float(torch.trapezoid(angle.cos().clamp(min=0.0) ** (freedom - 1), angle))  # noqa: E731
    return area(tail) / area(whole)
