"""Profile likelihood: how the cost rises when one parameter is fixed and the others follow.

The intervals may be skew. The cost counts correlated residuals as fewer, but its curvature is not quite that of the
standard error, which also covers nearby frames, episodes and grasp offsets. So the cost is scaled to have that
curvature (Chandler and Bate 2007), and a profile differs from the quadratic interval by its shape alone.
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

PROFILE_STEPS_STD_ERRORS = (0.5, 1.0, 2.0, 3.0)  # the last one where the cost has not risen enough before
COST_RISE_95 = 1.92  # half the 95 % quantile of chi-squared with one degree of freedom
MAX_PROFILE_ITERATIONS = 10  # of each fit along the profile

OnIterate = Callable[[levenberg_marquardt.Iterate], bool]
ProfilePoint = tuple[float, float]  # unconstrained value, rise of the scaled cost


def compute_profiles(
    objective: Objective,
    final: levenberg_marquardt.Iterate,
    covariance: Tensor,
    names: Sequence[str],
    on_iterate: OnIterate,
) -> dict[str, Profile]:
    """Compute the profiles of named unknowns.

    Args:
        objective: of the frames that were used.
        final: the solution.
        covariance: [K, K] of it.
        names: of unknowns.
        on_iterate: called with every point of the searches.
    """
    index = {u.name: k for k, u in enumerate(objective.unknowns)}
    out = {}
    for name in dict.fromkeys(names):
        k = index[name]
        below, above = (_walk_outwards(objective, final, covariance, k, sign, on_iterate) for sign in (-1, 1))
        out[name] = _assemble_profile(objective.unknowns[k], float(final.raw[k]), below, above)
    return out


def _walk_outwards(
    objective: Objective,
    final: levenberg_marquardt.Iterate,
    covariance: Tensor,
    k: int,
    sign: int,
    on_iterate: OnIterate,
) -> list[ProfilePoint]:
    """Points outwards, until the cost has risen enough, the parameter's domain ends or a simulation fails."""
    problem, unknown = objective.problem(), objective.unknowns[k]
    optimum = levenberg_marquardt.robust_cost(problem, final, final.raw, final.linear.residual)
    inverse = torch.linalg.inv(levenberg_marquardt.robust_curvature(problem, final))
    scale, follow = float(inverse[k, k] / covariance[k, k]), inverse[:, k] / inverse[k, k]
    raw, points = final.raw, []
    for step in PROFILE_STEPS_STD_ERRORS:
        target = float(final.raw[k] + sign * step * covariance[k, k].sqrt())
        value = unknown.clip(target)
        fixed = _fix_unknown(problem, final, k, value)
        start = fixed.clip(raw + follow * (value - raw[k]))
        try:
            at = levenberg_marquardt.minimise(fixed, start, MAX_PROFILE_ITERATIONS, on_iterate)
        except (SimulationDiverged, UnstableStep):
            break
        raw = at.raw
        cost = levenberg_marquardt.robust_cost(problem, final, raw, at.linear.residual)
        points.append((value, scale * (cost - optimum)))
        if points[-1][1] > COST_RISE_95 or value != target:
            break
    return points


def _fix_unknown(
    problem: levenberg_marquardt.Problem, final: levenberg_marquardt.Iterate, k: int, value: float
) -> levenberg_marquardt.Problem:
    """The problem with one unknown fixed and the noise scales of the optimum, so that costs can be compared."""
    column = torch.tensor([k])

    def linearise(raw: Tensor) -> levenberg_marquardt.Linearised:
        linear = problem.linearise(raw)
        return linear._replace(jacobian=linear.jacobian.index_fill(1, column, 0.0))

    def clip(raw: Tensor) -> Tensor:
        return problem.clip(raw).index_fill(0, column, value)

    return problem._replace(
        linearise=linearise,
        clip=clip,
        max_step=problem.max_step.index_fill(0, column, 0.0),
        fixed_scales=(final.scale, final.effective_fraction, final.outlier_cutoff),
    )


def _assemble_profile(unknown: Unknown, best: float, below: list[ProfilePoint], above: list[ProfilePoint]) -> Profile:
    low, high = (_interval_end(unknown, best, side) for side in (below, above))
    points = [*reversed(below), (best, 0.0), *above]
    skew = (high - best) / (best - low) if low is not None and high is not None and best > low else None
    interval = (None if low is None else unknown.value(low), None if high is None else unknown.value(high))
    return Profile([unknown.value(raw) for raw, _ in points], [rise for _, rise in points], interval, skew)


def _interval_end(unknown: Unknown, best: float, side: list[ProfilePoint]) -> float | None:
    """Where the cost has risen enough, by linear interpolation of its root; None where it does not."""
    at, root = best, 0.0
    for value, rise in side:
        root_here = max(rise, 0.0) ** 0.5
        if rise > COST_RISE_95:
            return at + (COST_RISE_95**0.5 - root) / (root_here - root) * (value - at)
        at, root = value, root_here
    return at if side and unknown.clip(at - 1e-9) == at else None  # the end of the domain
