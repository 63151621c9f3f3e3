"""Permutation test of a cause: would any other course over time have gained as much?

The slopes of the cause are permuted as placebos: within a time window they stay as they are, but they go to another
window of another motion. Such a placebo has the size and shape of the cause and cannot be what is wrong, so what it
gains on held-out motions is chance. An effect that is the same in all windows and motions, such as a camera offset, is
its own permutation. Such draws do not count, and if few are left the test is passed.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from ...episodes.world import WorldModel
from ..data.binning import BinnedResiduals, align_rows
from ..decide.criteria import CRITERIA
from .comparison import held_out_log_density
from .fitting import ModelFit, robust_step
from .noise import WhitenedBins
from .robust_weights import remove_weights, reweight


class PermutationTest(NamedTuple):
    """Result of a permutation test: linearised gains in log density on held-out motions.

    Attributes:
        gain: gain of the cause.
        quantile_95: 95 % quantile of the permutations' gains; 0 if there were too few.
    """

    gain: float
    quantile_95: float

    @property
    def is_passed(self) -> bool:
        """Whether the cause gains more than its permutations."""
        return self.gain > self.quantile_95


def run_permutation_test(
    fitted: ModelFit, motions: Sequence[str], halved: Collection[str] = (), seed: int = 0
) -> PermutationTest:
    """Test the last accepted cause of a fitted model.

    Args:
        fitted: a model with the cause.
        motions: label of each episode.
        halved: as in ``predict_held_out``.
        seed: of the permutations.
    """
    criteria, generator = CRITERIA.permutation, torch.Generator().manual_seed(seed)
    plain, n_coordinates = remove_weights(fitted.whitened), fitted.linearisation.n_coordinates
    slopes, cause = plain.jacobian[:, : n_coordinates - 1], plain.jacobian[:, n_coordinates - 1]
    without = plain._replace(value=plain.value - fitted.model.amplitudes[-1] * cause)
    zero_amplitude = fitted.model.at_point(torch.cat([fitted.model.point[:-1], torch.zeros(1).to(fitted.model.point)]))
    base_model = zero_amplitude.without_hypothesis(zero_amplitude.accepted[-1].name)
    base = _linearised_density(fitted, without._replace(jacobian=slopes), base_model, motions, halved)

    def compute_gain(column: Tensor) -> float:
        whitened = without._replace(jacobian=torch.cat([slopes, column[:, None]], 1))
        return _linearised_density(fitted, whitened, zero_amplitude, motions, halved) - base

    permutations = [_permute(fitted, n_coordinates - 1, generator) for _ in range(criteria.draws)]
    different = [p for p in permutations if abs(torch.cosine_similarity(p, cause, 0)) < criteria.max_cosine]
    if len(different) < criteria.min_draws:
        return PermutationTest(compute_gain(cause), 0.0)
    gains = torch.tensor([compute_gain(p) for p in different])
    return PermutationTest(compute_gain(cause), float(gains.quantile(criteria.quantile)))


def _linearised_density(
    fitted: ModelFit, whitened: WhitenedBins, model: WorldModel, motions: Sequence[str], halved: Collection[str]
) -> float:
    """Return the held-out log density of a model after one robust step."""
    step, _ = robust_step(whitened, model)
    moved = whitened._replace(value=whitened.value + whitened.jacobian @ step)
    result = replace(fitted.linearisation, n_coordinates=len(step))
    stepped = replace(fitted, model=model.at_point(model.point + step), whitened=reweight(moved), linearisation=result)
    return held_out_log_density(stepped, motions, halved)


def _permute(fitted: ModelFit, column: int, generator: torch.Generator) -> Tensor:
    """Return [B] whitened slopes of a permutation, with a random sign."""
    episodes = fitted.linearisation.bins
    count = len(episodes)
    shift = int(torch.randint(1, count, (), generator=generator)) if count > 1 else 0
    sign = 1 - 2 * int(torch.randint(2, (), generator=generator))
    raw = [
        sign * _take_slopes(bins, episodes[(k + shift) % count], column, generator) for k, bins in enumerate(episodes)
    ]
    whitened = [
        torch.linalg.solve_triangular(factor, slopes[:, None], upper=False)[:, 0]
        for factor, slopes in zip(fitted.whitened.cholesky_factors, raw, strict=True)
    ]
    return torch.cat(whitened)


def _take_slopes(target: BinnedResiduals, donor: BinnedResiduals, column: int, generator: torch.Generator) -> Tensor:
    """Return [B] slopes of the donor with its windows in another order; zero where it has no such bin."""
    n_windows = int(torch.cat([target.window, donor.window, target.window.new_zeros(1)]).max()) + 1
    order = torch.randperm(n_windows, generator=generator)
    key = target._replace(window=order[target.window]).key
    return align_rows(key, donor.key, donor.jacobian[:, column])
