"""Whether a search that did not converge ended near enough to the optimum to say something.

A search that ended at the noise, and that its slopes lead no farther than a standard error, has only flat directions
left. Its errors are widened by the distance that remains. Slopes at any other end say nothing about the optimum, and
errors computed from them are far too small.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from ...episodes.unknowns import Unknown
from . import levenberg_marquardt
from .box_qp import solve_box_qp
from .linearity import LinearityCheck
from .objective import Objective


@dataclass(frozen=True)
class ConvergenceCriteria:
    """When the end of an unfinished search may be an estimate.

    Attributes:
        max_residual_over_noise: rms residual over the sensor noise. Searches that were cut short ended at 0.3 to 1.2,
            with errors that held, or at 1.4 to 6.
        max_prior_stds: standard deviations of the prior within which the remaining step is sought.
        max_remaining_std_errors: standard errors to the predicted optimum. A converged search ends within 0.1; the
            slopes of one that was cut short promise less than what remains.
        min_relative_slope: of a bounded parameter by its unconstrained number, over the largest slope. Of 45 strangers'
            benches one ended below: at a Poisson's ratio of 0.4999, with E h 5 standard errors off.
    """

    max_residual_over_noise: float = 1.3
    max_prior_stds: float = 10.0
    max_remaining_std_errors: float = 1.0
    min_relative_slope: float = 0.02


CONVERGENCE_CRITERIA = ConvergenceCriteria()


def find_failure_reason(
    objective: Objective, checked: LinearityCheck, criteria: ConvergenceCriteria = CONVERGENCE_CRITERIA
) -> str:
    """Return why the end of an unfinished search is no estimate; empty where it may be one.

    The residual must be near the sensor noise, where that is known, and the slopes must ask for no more than a step
    that the error bars cover.

    Args:
        objective: of the frames that were used.
        checked: where the search ended.
        criteria: the limits.
    """
    episodes = objective.episodes if objective.uses("points", "markers") else []
    noise = max((e.noise_std for e in episodes if e.noise_std), default=math.nan)
    ratio = objective.distance_metrics(checked.final.raw).rms / noise
    if ratio > criteria.max_residual_over_noise:
        return f"the residual is {ratio:.1f} times the sensor noise"
    if checked.covariance is not None:  # the slopes do not cover all data that were used
        return "" if checked.final.converged else "simulations around it lead farther"
    names = [u.name for u in objective.unknowns]
    ignored = [names.index(name) for name in checked.unusable_parameters]
    remaining = remaining_std_errors(objective.problem(), checked.final, criteria, ignored)
    is_far = remaining > criteria.max_remaining_std_errors
    return f"its slopes lead {remaining:.0f} standard errors farther" if is_far else ""


def find_limit_reasons(
    unknowns: Sequence[Unknown], raw: Tensor, criteria: ConvergenceCriteria = CONVERGENCE_CRITERIA
) -> dict[str, str]:
    """Return why parameters are no estimates, by name: a bounded one of the same law is at the end of its range.

    The unconstrained number has no effect there any more, so the law's other standard errors are those of a fit without
    it. Forces that do not depend on this law keep their estimates.

    Args:
        unknowns: parameters of the fit.
        raw: [K] the solution; nuisances may follow.
        criteria: the limits.
    """
    reasons = {}
    for unknown, number in zip(unknowns, raw.tolist(), strict=False):
        share = 1 / (1 + math.exp(-number)) if unknown.parameter.domain == "unit_half" else 0.5
        if 4 * share * (1 - share) < criteria.min_relative_slope:
            law = unknown.key.removesuffix(f"{unknown.name}.raw")
            reason = f"{unknown.name} ended at {0.5 * share:.4f}, the end of its range"
            reasons |= {u.name: reason for u in unknowns if u.key.startswith(law)}
    return reasons


def remaining_std_errors(
    problem: levenberg_marquardt.Problem,
    at: levenberg_marquardt.Iterate,
    criteria: ConvergenceCriteria = CONVERGENCE_CRITERIA,
    ignored: Sequence[int] = (),
) -> float:
    """Return how far the minimum is that the slopes predict, in standard errors of the reported unknowns.

    Unknowns that are ``ignored`` stay where they are.
    """
    gradient, hessian = levenberg_marquardt.normal_equations(problem, at)
    reach = criteria.max_prior_stds * problem.prior_std
    reach[list(ignored)] = 0
    low, high = (problem.clip(at.raw + sign * reach) - at.raw for sign in (-1, 1))
    step = solve_box_qp(hessian, -gradient, low, high)
    return levenberg_marquardt.step_in_std_errors(problem, hessian, step, ignored)
