"""Forces that grow with time in all motions alike: too little to be seen in one of them, and no chance in all.

The rate c of a force c t, from each episode's start on, is in one episode

    c_k = d' K^-1 r / d' K^-1 d,  variance 1 / d' K^-1 d,

with K what a right model leaves (``lacking.right``), which knows of tares, and d the time of the cells of that force.
Episodes are pooled with what they differ by beyond that (DerSimonian and Laird 1986): what depends on the motion is no
drift.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from .cells import SEEN
from .fitting import Fitted
from .lacking import RARE, right

FEWEST = 3  # episodes that can be alike
AXES = "xyz"


class Drift(NamedTuple):
    """Of the forces on all grippers, measured less simulated, along one axis of the world."""

    axis: str
    rate: float  # N/s
    std: float
    p: float  # of a right model's drifting as much along any axis

    @property
    def lacking(self) -> bool:
        """No chance."""
        return self.p < RARE

    def as_dict(self) -> dict[str, Any]:
        """As diagnosis.json has it."""
        return {**self._asdict(), "unit": "N/s", "lacking": self.lacking}


def drifts(found: Fitted) -> list[Drift]:
    """One for each axis; none where fewer than three episodes have forces."""
    later = lambda c: bool(((c.block == SEEN) & (c.time > c.time.min())).any())  # noqa: E731
    every = [_rates(found, k) for k, cells in enumerate(found.evidence.cells) if later(cells)]
    if len(every) < FEWEST:
        return []
    rates, variances = (torch.stack(column) for column in zip(*every, strict=True))
    rows = []
    for axis, rate, variance in zip(AXES, rates.mT, variances.mT, strict=True):
        mean, std = _pooled(rate, variance)
        chance = float(torch.special.erfc(torch.tensor(abs(mean) / std / 2**0.5)))
        rows.append(Drift(axis, mean, std, min(1.0, len(AXES) * chance)))
    return rows


def _rates(found: Fitted, k: int) -> tuple[Tensor, Tensor]:
    """(rates, variances) [axes] of one episode with forces in more than one window."""
    cells = found.evidence.cells[k]
    axis = torch.arange(len(AXES))
    here = (cells.block == SEEN)[:, None] & (cells.patch[:, None] % 3 == axis)
    since = torch.where(here, (cells.time - cells.time.min())[:, None], 0.0)
    still, moved = right(found, k)
    weighed = torch.linalg.solve(still + moved @ moved.mT, since)
    variance = 1 / (weighed * since).sum(0)
    return variance * (weighed.mT @ cells.value), variance


def _pooled(rate: Tensor, variance: Tensor) -> tuple[float, float]:
    """(mean, standard error) by what episodes are known to and what they differ by."""
    known = 1 / variance
    over = (known * (rate - (known @ rate) / known.sum()) ** 2).sum() - (len(rate) - 1)
    between = float(over / (known.sum() - known.square().sum() / known.sum()))
    weight = 1 / (variance + max(0.0, between))
    return float(weight @ rate / weight.sum()), float(weight.sum().rsqrt())
