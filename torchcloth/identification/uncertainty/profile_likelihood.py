"""How the cost rises when one parameter is held beside its estimate and the others follow: intervals that may be skew.

The cost counts correlated residuals as fewer, but its curvature is not quite the standard error's, which knows more
(nearby frames, episodes, held places). It is scaled to have that curvature (Chandler and Bate 2007), so that a profile
differs from the quadratic interval by its shape alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from ...episodes.unknowns import Unknown
from ...errors import SimulationDiverged, UnstableStep
from ..estimators import levenberg_marquardt
from ..estimators.objective import Objective
from .estimates import Profile

STEPS = (0.5, 1.0, 2.0, 3.0)  # standard errors; the last where the cost has not risen enough before
RISE = 1.92  # half the 95 % quantile of chi-squared with one degree of freedom
ITERATIONS = 10

OnIterate = Callable[[levenberg_marquardt.Iterate], bool]
Point = tuple[float, float]  # unconstrained value, rise of the scaled cost


def profiles(
    objective: Objective,
    final: levenberg_marquardt.Iterate,
    covariance: Tensor,
    names: Sequence[str],
    on_iterate: OnIterate,
) -> dict[str, Profile]:
    """Of the named unknowns; ``on_iterate`` sees every point of the searches."""
    index = {u.name: k for k, u in enumerate(objective.unknowns)}
    out = {}
    for name in dict.fromkeys(names):
        k = index[name]
        sides = [_walk(objective, final, covariance, k, sign, on_iterate) for sign in (-1, 1)]
        out[name] = _profile(objective.unknowns[k], float(final.raw[k]), *sides)
    return out


def _walk(
    objective: Objective,
    final: levenberg_marquardt.Iterate,
    covariance: Tensor,
    k: int,
    sign: int,
    on_iterate: OnIterate,
) -> list[Point]:
    """Outwards until the cost has risen enough, the parameter's domain ends or it cannot be simulated."""
    problem, unknown = objective.problem(), objective.unknowns[k]
    least = levenberg_marquardt.cost(problem, final, final.raw, final.linear.value)
    inverse = torch.linalg.inv(levenberg_marquardt.curvature(problem, final))
    scale, follow = float(inverse[k, k] / covariance[k, k]), inverse[:, k] / inverse[k, k]
    raw, found = final.raw, []
    for step in STEPS:
        wanted = float(final.raw[k] + sign * step * covariance[k, k].sqrt())
        value = unknown.clip(wanted)
        held = _held(problem, final, k, value)
        try:
            at = levenberg_marquardt.minimise(held, held.clip(raw + follow * (value - raw[k])), ITERATIONS, on_iterate)
        except (SimulationDiverged, UnstableStep):
            break
        raw = at.raw
        found.append((value, scale * (levenberg_marquardt.cost(problem, final, raw, at.linear.value) - least)))
        if found[-1][1] > RISE or value != wanted:
            break
    return found


def _held(
    problem: levenberg_marquardt.Problem, final: levenberg_marquardt.Iterate, k: int, value: float
) -> levenberg_marquardt.Problem:
    """The same with one unknown held, and the noise scales of the optimum: costs can be compared."""

    def linearise(raw: Tensor) -> levenberg_marquardt.Linearised:
        linear = problem.linearise(raw)
        return linear._replace(jacobian=linear.jacobian.index_fill(1, torch.tensor([k]), 0.0))

    def clip(raw: Tensor) -> Tensor:
        return problem.clip(raw).index_fill(0, torch.tensor([k]), value)

    longest = problem.longest.index_fill(0, torch.tensor([k]), 0.0)
    scales = (final.scale, final.share, final.gate)
    return problem._replace(linearise=linearise, clip=clip, longest=longest, scales=scales)


def _profile(unknown: Unknown, best: float, below: list[Point], above: list[Point]) -> Profile:
    ends = [_end(unknown, best, side) for side in (below, above)]
    points = [*reversed(below), (best, 0.0), *above]
    low, high = ends
    skew = (high - best) / (best - low) if low is not None and high is not None and best > low else None
    interval = (None if low is None else unknown.value(low), None if high is None else unknown.value(high))
    return Profile([unknown.value(raw) for raw, _ in points], [rise for _, rise in points], interval, skew)


def _end(unknown: Unknown, best: float, side: list[Point]) -> float | None:
    """Where the cost has risen enough: its root is nearly linear. None: it does not."""
    at, root = best, 0.0
    for value, rise in side:
        now = max(rise, 0.0) ** 0.5
        if rise > RISE:
            return at + (RISE**0.5 - root) / (now - root) * (value - at)
        at, root = value, now
    return at if side and unknown.clip(at - 1e-9) == at else None  # the end of the domain
