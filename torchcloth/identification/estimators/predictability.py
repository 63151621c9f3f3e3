"""How long a motion can be predicted: the frames over which derivatives hold.

Light cloth that buckles forgets small differences. Its tangents grow some tenfold in a third of a second, for ever,
while the ripples that differ stay millimetres high. Before that, the motion is as regular as any other, and the data
contain as much information as the tangents say. Where the whole motion fails the test of ``linearity``, this module
seeks the longest beginning that passes it. The test itself shows up to which frame its derivatives held, so that
beginning is tried first.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from ...errors import SimulationDiverged, UnstableStep
from . import levenberg_marquardt
from .linearity import LinearityCheck, check_linearity, has_runaway_tangents, relative_error
from .objective import Objective


@dataclass(frozen=True)
class PredictabilitySettings:
    """How the longest predictable beginning is sought.

    Attributes:
        fractions: fractions of the frames, tried one after the other.
        max_bisections: bisections between the last fraction that passes and the first that fails.
        max_iterations: steps of each search.
        growing_tolerance: standard errors of a step that ends a search while the beginning grows.
        final_tolerance: standard errors of a step that ends the search on the longest beginning.
        max_relative_error: relative error of the tangents up to which the first beginning reaches. A beginning leaves
            wider errors than all frames do, over which its own tangents must hold.
    """

    fractions: tuple[float, ...] = (0.1, 0.15, 0.22, 0.33, 0.5, 0.75)
    max_bisections: int = 2
    max_iterations: int = 20
    growing_tolerance: float = 1.0
    final_tolerance: float = 0.3
    max_relative_error: float = 0.25


PREDICTABILITY_SETTINGS = PredictabilitySettings()


class PredictableFit(NamedTuple):
    """A solution on the beginning of the episodes.

    Attributes:
        objective: of those frames.
        checked: the solution, whose derivatives hold.
        duration: length of the beginning [s].
    """

    objective: Objective
    checked: LinearityCheck
    duration: float


OnIterate = Callable[[levenberg_marquardt.Iterate, Objective], bool]


def fit_predictable_part(
    objective: Objective,
    failed: LinearityCheck,
    start: Tensor,
    on_iterate: OnIterate,
    settings: PredictabilitySettings = PREDICTABILITY_SETTINGS,
) -> PredictableFit | None:
    """Fit the longest beginning of the motion that can be predicted.

    The first one is as long as the derivatives of all frames held. Where that fails, the beginning grows, and each
    search starts from the solution before. From a wrong start the later ripples are wrong as well, and lead nowhere.

    Args:
        objective: of all frames.
        failed: the check that all frames failed.
        start: [K].
        on_iterate: called with (iterate, objective) at every point; returns True to stop.
        settings: which beginnings are tried.

    Returns:
        The solution, or None where no beginning can be predicted.
    """
    near, exact = settings.growing_tolerance, settings.final_tolerance
    best, high = None, 1.0
    longest = find_predictable_fraction(objective, failed, settings.max_relative_error)
    if longest > settings.fractions[0]:
        direct = _solve_part(objective, longest, start, on_iterate, exact, settings)
        if direct is not None:
            return _describe(objective, failed, *direct)
        high = longest
    for fraction in [f for f in settings.fractions if f < high]:
        begin = start if best is None else best[1].final.raw
        result = _solve_part(objective, fraction, begin, on_iterate, near, settings)
        if result is not None:
            best, low = result, fraction
        elif best is not None:
            high = fraction
            break
    if best is None:
        return None
    for _ in range(settings.max_bisections):
        fraction = 0.5 * (low + high)
        result = _solve_part(objective, fraction, best[1].final.raw, on_iterate, near, settings)
        low, high, best = (low, fraction, best) if result is None else (fraction, high, result)
    part, checked = best
    exact_result = _solve_part(objective, low, checked.final.raw, on_iterate, exact, settings)
    part, checked = exact_result or (part, checked._replace(final=checked.final._replace(converged=False)))
    return _describe(objective, failed, part, checked)


def find_predictable_fraction(objective: Objective, failed: LinearityCheck, max_relative_error: float) -> float:
    """Return the fraction of the frames before the derivatives of all frames failed; 0 where that is not known.

    Args:
        objective: of all frames.
        failed: the check that all frames failed.
        max_relative_error: of the tangents over a finite step, of all rows up to a frame.
    """
    if failed.failed_tangents is None:
        return 0.0
    tangent, steps = failed.failed_tangents
    frame, count = frames_within_episodes(objective, failed.final.linear)
    fraction, order = ((frame + 1) / count).sort(stable=True)
    weight = failed.final.row_weights()[0][order, None]
    secant, tangent = failed.final.linear.jacobian[order, : len(steps)], tangent[order]
    squares = torch.stack([secant, tangent, secant - tangent]).square()
    is_last = torch.cat([fraction[1:] > fraction[:-1], torch.ones(1, dtype=torch.bool)])  # row of its frame
    holds = (relative_error((weight * squares).cumsum(1), steps)[is_last] < max_relative_error).all(1)
    fails = (~holds).nonzero()
    first = int(fails[0]) if len(fails) else len(holds)
    return float(fraction[is_last][first - 1]) if first else 0.0


def frames_within_episodes(objective: Objective, linear: levenberg_marquardt.Linearised) -> tuple[Tensor, Tensor]:
    """Return the number [R] of each row's frame within its episode, and [R] of the frames that it has."""
    episode = objective.episode_of_rows(linear)
    gap = levenberg_marquardt.DEFAULT_NOISE_MODEL.frames_per_time_block
    length = torch.tensor([len(e.times) + gap for e in objective.episodes])
    observed = torch.tensor([e.observed_count for e in objective.episodes])
    return linear.frame - (length.cumsum(0) - length)[episode], observed[episode]


def _describe(objective: Objective, failed: LinearityCheck, part: Objective, checked: LinearityCheck) -> PredictableFit:
    """Return a fit of a beginning, with a warning that says how long that is."""
    frames, count = (max(e.observed_count for e in o.episodes) for o in (part, objective))
    duration = max(float(e.times[e.observed_count - 1] - e.times[0]) for e in part.episodes)
    warning = (
        f"{failed.failure_reason}: derivatives hold for the first {duration:.2f} s only, and only those frames, "
        f"{frames} of {count}, were used"
    )
    return PredictableFit(part, checked._replace(warnings=[warning]), duration)


def _solve_part(
    objective: Objective,
    fraction: float,
    start: Tensor,
    on_iterate: OnIterate,
    tolerance: float,
    settings: PredictabilitySettings,
) -> tuple[Objective, LinearityCheck] | None:
    """Solution on a fraction of the frames; None where derivatives do not hold."""
    part = objective.first_fraction(fraction)
    if not part.has_data:
        return None
    try:
        final = levenberg_marquardt.minimise(
            part.problem(), start, settings.max_iterations, lambda it: on_iterate(it, part), tolerance
        )
        checked = None if has_runaway_tangents(part, final) else check_linearity(part, final)
    except (SimulationDiverged, UnstableStep):
        checked = None
    objective.simulations += part.simulations
    return None if checked is None or checked.is_withdrawn else (part, checked)
