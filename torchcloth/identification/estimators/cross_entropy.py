"""A search for the fabric by simulations alone, where slopes lead astray.

At a bench whose errors are unknown the cost has many hollows, and slopes lead into the nearest one. The cross-entropy
method (Rubinstein 1999) draws fabrics, keeps the best of them, and draws anew around these. Errors of the observer,
which need no simulation, are fitted to each draw. Errors that act on the cloth wait for the search by slopes that
follows.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from ...episodes.replay import Frames
from . import levenberg_marquardt
from .multistart import comparable_costs
from .objective import Objective


@dataclass(frozen=True)
class CrossEntropySettings:
    """How fabrics are drawn.

    Attributes:
        rounds: largest number of rounds.
        min_rounds: smallest number of rounds.
        draws_per_unknown: fabrics in a round, for each unknown.
        elite_fraction: of the draws around which the next round is drawn.
        widening: of the elite's standard deviation, which selection makes too small.
        start_std: standard deviation of the first round: of the logarithm of what cannot be negative.
        start_std_ratio: the same of any other unknown, over the standard deviation of its prior.
        min_amplitude_ratio: smallest amplitude that is drawn, over its typical size.
        min_cost_decrease: of the best fabric, below which a round is the last: slopes find what is left.
        points_per_frame: to which clouds are thinned.
    """

    rounds: int = 5
    min_rounds: int = 3
    draws_per_unknown: int = 6
    elite_fraction: float = 0.25
    widening: float = 1.2
    start_std: float = 1.2
    start_std_ratio: float = 0.5
    min_amplitude_ratio: float = 0.05
    min_cost_decrease: float = 1.0
    points_per_frame: int = 400


CROSS_ENTROPY_SETTINGS = CrossEntropySettings()


class Axis(NamedTuple):
    """One coordinate of the search.

    Attributes:
        index: of the unknown.
        std: standard deviation of the first round.
        least: smallest value of an unknown that is stored as it is and cannot be negative: its logarithm is drawn.
            None: the unknown itself is drawn.
    """

    index: int
    std: float
    least: float | None = None

    def to_place(self, raw: float) -> float:
        """Return the coordinate of an unknown."""
        return raw if self.least is None else math.log(max(raw, self.least))

    def from_place(self, place: float) -> float:
        """Return the unknown at a coordinate."""
        return place if self.least is None else math.exp(place)


class Draw(NamedTuple):
    """One fabric, with the errors of the observer that fit it best.

    Attributes:
        place: [D] coordinates of the search.
        at: the point of the objective.
    """

    place: Tensor
    at: levenberg_marquardt.Iterate


def search_by_draws(
    objective: Objective,
    start: Tensor,
    on_round: Callable[[Tensor], bool],
    settings: CrossEntropySettings = CROSS_ENTROPY_SETTINGS,
) -> Tensor:
    """Return the best point [K] of a search by simulations.

    Args:
        objective: whose nuisances do not act on the cloth.
        start: [K].
        on_round: called with the best point [K] of each round; returns True to stop.
        settings: how fabrics are drawn.

    Raises:
        SimulationDiverged: at the start.
        UnstableStep: at the start.
    """
    problem = objective.problem()
    axes = _list_axes(objective, settings)
    generator = torch.Generator().manual_seed(0)
    count = max(2, settings.draws_per_unknown * len(axes))
    mean = torch.tensor([axis.to_place(float(start[axis.index])) for axis in axes], dtype=torch.float64)
    std = torch.tensor([axis.std for axis in axes], dtype=torch.float64)
    best = Draw(mean, _fit_observer(objective, start, objective.simulate_cloth(start)))
    for round_index in range(settings.rounds):
        draws = [best]
        offsets = torch.randn(count - 1, len(axes), generator=generator, dtype=torch.float64)
        places = torch.cat([mean[None], mean + std * offsets])
        points = best.at.raw.repeat(len(places), 1)
        for axis, column in zip(axes, places.T.tolist(), strict=True):
            points[:, axis.index] = torch.tensor([axis.from_place(coordinate) for coordinate in column])
        simulated = objective.simulate_fabrics(best.at.raw, points[:, : len(objective.unknowns)])
        for place, raw, frames in zip(places, points, simulated, strict=True):
            if frames is not None:
                draws.append(Draw(place, _fit_observer(objective, raw, frames)))
        costs = comparable_costs(problem, [draw.at for draw in draws])
        order = sorted(range(len(draws)), key=costs.__getitem__)[: max(2, round(settings.elite_fraction * count))]
        best, elite = draws[order[0]], torch.stack([draws[i].place for i in order])
        mean, std = elite.mean(0), settings.widening * elite.std(0)
        has_stalled = costs[0] - costs[order[0]] < settings.min_cost_decrease  # the first draw is the best one so far
        if on_round(best.at.raw) or (has_stalled and round_index + 1 >= settings.min_rounds):
            break
    return best.at.raw


def _fit_observer(objective: Objective, raw: Tensor, simulated: Sequence[Frames]) -> levenberg_marquardt.Iterate:
    """Take one Gauss-Newton step of what the observer gets wrong, with the cloth as it moves at ``raw`` [K]."""
    return levenberg_marquardt.take_step(objective.observer_problem(raw, simulated), raw)


def _list_axes(objective: Objective, settings: CrossEntropySettings) -> list[Axis]:
    """Return what is searched: the fabric's unknowns that were not measured."""
    axes = []
    for k, unknown in enumerate(objective.unknowns):
        if unknown.measured:
            continue
        least = settings.min_amplitude_ratio * unknown.typical_amplitude
        is_scale = unknown.parameter.domain in ("positive", "nonnegative")
        std = settings.start_std if is_scale else settings.start_std_ratio * unknown.prior_std
        axes.append(Axis(k, std, least if unknown.parameter.domain == "nonnegative" else None))
    return axes
