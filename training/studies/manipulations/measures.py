"""Statistics over cases: mean, coefficient of variation, the paper's pooled variance."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np


class Spread(NamedTuple):
    """Statistics of one quantity over cases.

    Attributes:
        mean: of the values.
        cov: standard deviation over mean; NaN with fewer than two values.
        count: number of values.
    """

    mean: float
    cov: float
    count: int


def sample_spread(values: Sequence[float]) -> Spread:
    """Compute mean and coefficient of variation (with n - 1); NaN without values."""
    if not len(values):
        return Spread(math.nan, math.nan, 0)
    mean = float(np.mean(values))
    return Spread(mean, float(np.std(values, ddof=1)) / mean if len(values) > 1 else math.nan, len(values))


class Pooled(NamedTuple):
    """Statistics of one quantity over the levels of a factor.

    Attributes:
        mean: of all values.
        pooled_variance: the paper's variance within plus between the levels.
        between: variance between the levels, the effect of the factor.
        levels: statistics of each level.
    """

    mean: float
    pooled_variance: float
    between: float
    levels: dict[str, Spread]


def pooled_variance(groups: Mapping[str, Sequence[float]]) -> Pooled:
    """Compute the paper's sum over levels of N_i V_i + N_i (a_i - a)^2, divided by the number of all values.

    Both parts add up to the variance of all values for any levels; only the second one depends on the factor.
    """
    groups = {level: values for level, values in groups.items() if len(values)}
    every = np.concatenate([np.asarray(values, dtype=float) for values in groups.values()]) if groups else np.empty(0)
    if not len(every):
        return Pooled(math.nan, math.nan, math.nan, {})
    mean = float(every.mean())
    within = sum(len(values) * float(np.var(values)) for values in groups.values()) / len(every)
    between = sum(len(values) * (float(np.mean(values)) - mean) ** 2 for values in groups.values()) / len(every)
    return Pooled(mean, within + between, between, {level: sample_spread(values) for level, values in groups.items()})
