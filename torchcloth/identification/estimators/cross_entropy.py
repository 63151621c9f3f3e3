"""The first search for the fabric, by simulations alone.

At a bench whose errors are unknown the cost has many hollows, and slopes lead into the nearest one. The cross-entropy
method (Rubinstein 1999) draws fabrics, keeps the best of them, and draws anew around these. Errors of the observer,
which need no simulation, are fitted to each draw. Errors that act on the cloth wait for the search by slopes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from ...episodes.unknowns import Unknown
from ...errors import SimulationDiverged, UnstableStep
from . import levenberg_marquardt
from .objective import Objective


@dataclass(frozen=True)
class CrossEntropySettings:
    """How fabrics are drawn.

    Attributes:
        rounds: largest number of rounds.
        draws_per_unknown: fabrics in a round, for each unknown.
        elite_fraction: of the draws around which the next round is drawn.
        widening: of the elite's standard deviation, which selection makes too small.
        start_std: standard deviation of the first round: of the logarithm of what cannot be negative.
        start_std_ratio: the same of any other unknown, over the standard deviation of its prior.
        min_amplitude_ratio: smallest amplitude that is drawn, over its typical size.
        end_cost_range: the search ends when the costs of the elite differ by no more: slopes find what is left.
        points_per_frame: to which clouds are thinned.
    """

    rounds: int = 5
    draws_per_unknown: int = 6
    elite_fraction: float = 0.25
    widening: float = 1.2
    start_std: float = 1.2
    start_std_ratio: float = 0.5
    min_amplitude_ratio: float = 0.05
    end_cost_range: float = 1.0
    points_per_frame: int = 400


CROSS_ENTROPY_SETTINGS = CrossEntropySettings()


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
    searched = [(k, u) for k, u in enumerate(objective.unknowns) if not u.measured]
    generator = torch.Generator().manual_seed(0)
    count = max(2, settings.draws_per_unknown * len(searched))
    mean = torch.tensor([_to_place(u, float(start[k]), settings) for k, u in searched], dtype=torch.float64)
    std = torch.tensor([_start_std(u, settings) for _, u in searched], dtype=torch.float64)
    best = Draw(mean, _fit_observer(objective, start))
    for _ in range(settings.rounds):
        draws = [best]
        offsets = torch.randn(count - 1, len(searched), generator=generator, dtype=torch.float64)
        for place in [mean, *(mean + std * offset for offset in offsets)]:
            raw = best.at.raw.clone()
            for (k, u), coordinate in zip(searched, place.tolist(), strict=True):
                raw[k] = _from_place(u, coordinate)
            try:
                draws.append(Draw(place, _fit_observer(objective, raw)))
            except (SimulationDiverged, UnstableStep):
                continue
        reference = min((draw.at for draw in draws), key=lambda at: float(at.scale.log().sum()))
        costs = [levenberg_marquardt.robust_cost(problem, reference, d.at.raw, d.at.linear.residual) for d in draws]
        order = sorted(range(len(draws)), key=costs.__getitem__)[: max(2, round(settings.elite_fraction * count))]
        best = draws[order[0]]
        elite = torch.stack([draws[i].place for i in order])
        mean, std = elite.mean(0), settings.widening * elite.std(0)
        if on_round(best.at.raw) or costs[order[-1]] - costs[order[0]] <= settings.end_cost_range:
            break
    return best.at.raw


def _fit_observer(objective: Objective, raw: Tensor) -> levenberg_marquardt.Iterate:
    """Take one Gauss-Newton step of what the observer gets wrong, with the cloth as it moves at ``raw`` [K]."""
    return levenberg_marquardt.minimise(objective.observer_problem(raw), raw, 1, lambda at: False)


def _is_ratio(unknown: Unknown) -> bool:
    """Whether an unknown is stored as it is and cannot be negative: draws are of its logarithm."""
    return unknown.parameter.domain == "nonnegative"


def _start_std(unknown: Unknown, settings: CrossEntropySettings) -> float:
    is_scale = unknown.parameter.domain in ("positive", "nonnegative")
    return settings.start_std if is_scale else settings.start_std_ratio * unknown.prior_std


def _to_place(unknown: Unknown, raw: float, settings: CrossEntropySettings) -> float:
    if not _is_ratio(unknown):
        return raw
    return math.log(max(raw, settings.min_amplitude_ratio * unknown.typical_amplitude))


def _from_place(unknown: Unknown, place: float) -> float:
    return unknown.clip(math.exp(place) if _is_ratio(unknown) else place)
