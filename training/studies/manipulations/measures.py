"""Numbers over cases: mean, coefficient of variation, the paper's pooled variance."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np


class Spread(NamedTuple):
    """Of one quantity over cases."""

    mean: float
    cov: float  # standard deviation over mean; NaN with fewer than two
    count: int


def spread(values: Sequence[float]) -> Spread:
    """Mean and coefficient of variation (of the sample: n - 1); NaN where there is nothing to take them of."""
    if not len(values):
        return Spread(math.nan, math.nan, 0)
    mean = float(np.mean(values))
    return Spread(mean, float(np.std(values, ddof=1)) / mean if len(values) > 1 else math.nan, len(values))


class Pooled(NamedTuple):
    """Of one quantity over the levels of a factor."""

    mean: float  # grand mean, of all values
    pooled: float  # the paper's: variance within the levels plus that between them
    between: float  # the second part alone: what the factor does
    levels: dict[str, Spread]


def pooled(groups: Mapping[str, Sequence[float]]) -> Pooled:
    """The paper's formula: sum over levels of N_i V_i + N_i (a_i - a)^2, by the number of all values.

    Its two parts add up to the variance of all values, whatever the levels: only the second knows the factor.
    """
    groups = {level: values for level, values in groups.items() if len(values)}
    every = np.concatenate([np.asarray(values, dtype=float) for values in groups.values()]) if groups else np.empty(0)
    if not len(every):
        return Pooled(math.nan, math.nan, math.nan, {})
    mean = float(every.mean())
    within = sum(len(values) * float(np.var(values)) for values in groups.values()) / len(every)
    between = sum(len(values) * (float(np.mean(values)) - mean) ** 2 for values in groups.values()) / len(every)
    return Pooled(mean, within + between, between, {level: spread(values) for level, values in groups.items()})
