"""Would any course over time have done as well? A cause's slopes, exchanged between windows and motions, as placebos.

What a cause does to the cells is kept as it is within a window, but goes to another window of another motion. Such a
placebo has the cause's size and shape and cannot be what is wrong. What it gains on motions held out is chance. Of
what is alike in all windows and motions, as of a camera that stands elsewhere, an exchange is the cause itself: such
draws do not count, and where few are left nothing can be asked.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from ...episodes.world import Model
from ..data.binning import BinnedResiduals, align_rows
from .comparison import held_out_log_density
from .fitting import ModelFit, robust_step
from .noise import WhitenedBins
from .robust_weights import reweight, remove_weights

DRAWS, LEVEL = 40, 0.95
ITSELF, FEWEST = 0.9, 10  # cosine with the cause, from which a draw is none; draws that must be left


class PermutationTest(NamedTuple):
    """Log density that is gained on motions held out, where slopes hold all the way."""

    gain: float  # by the cause
    quantile_95: float  # what 95 % of the placebos stay below; 0 where there are none

    @property
    def is_passed(self) -> bool:
        """The cause does what no other course would."""
        return self.gain > self.quantile_95


def run_permutation_test(found: ModelFit, groups: Sequence[str], halved: Collection[str] = (), seed: int = 0) -> PermutationTest:
    """Of the last accepted cause of a fitted model."""
    rng = torch.Generator().manual_seed(seed)
    plain, own = remove_weights(found.whitened), found.linearisation.n_coordinates
    slopes, column = plain.jacobian[:, : own - 1], plain.jacobian[:, own - 1]
    without = plain._replace(value=plain.value - found.model.amplitudes[-1] * column)
    nothing = found.model.at(torch.cat([found.model.point[:-1], torch.zeros(1).to(found.model.point)]))
    less = nothing.without(nothing.accepted[-1].name)
    none = _held_out(found, without._replace(jacobian=slopes), less, groups, halved)

    def gain(change: Tensor) -> float:
        white = without._replace(jacobian=torch.cat([slopes, change[:, None]], 1))
        return _held_out(found, white, nothing, groups, halved) - none

    drawn = [_exchanged(found, own - 1, rng) for _ in range(DRAWS)]
    others = [change for change in drawn if abs(torch.cosine_similarity(change, column, 0)) < ITSELF]
    if len(others) < FEWEST:
        return PermutationTest(gain(column), 0.0)
    return PermutationTest(gain(column), float(torch.tensor([gain(change) for change in others]).quantile(LEVEL)))


def _held_out(found: ModelFit, white: WhitenedBins, model: Model, groups: Sequence[str], halved: Collection[str]) -> float:
    """Log density of all motions, each by the others, of a model whose numbers go where one leap leads."""
    step, _ = robust_step(white, model)
    there = white._replace(value=white.value + white.jacobian @ step)
    evidence = replace(found.linearisation, own=len(step))
    return held_out_log_density(
        replace(found, model=model.at(model.point + step), white=reweight(there), evidence=evidence), groups, halved
    )


def _exchanged(found: ModelFit, place: int, rng: torch.Generator) -> Tensor:
    """[C] whitened slopes of a placebo, of either sign."""
    cells = found.linearisation.bins
    count = len(cells)
    turn = int(torch.randint(1, count, (), generator=rng)) if count > 1 else 0
    sign = 1 - 2 * int(torch.randint(2, (), generator=rng))
    raw = [sign * _from(c, cells[(k + turn) % count], place, rng) for k, c in enumerate(cells)]
    roots = found.whitened.cholesky_factors
    return torch.cat(
        [torch.linalg.solve_triangular(r, v[:, None], upper=False)[:, 0] for r, v in zip(roots, raw, strict=True)]
    )


def _from(to: BinnedResiduals, donor: BinnedResiduals, place: int, rng: torch.Generator) -> Tensor:
    """[C] slopes of the donor's cells in another order of the windows; zero where it has no such cell."""
    order = torch.randperm(int(torch.cat([to.window, donor.window, to.window.new_zeros(1)]).max()) + 1, generator=rng)
    key = to._replace(window=order[to.window]).key
    return align_rows(key, donor.key, donor.jacobian[:, place])
