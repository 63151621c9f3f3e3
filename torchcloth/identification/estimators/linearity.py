"""Check whether the derivatives at a solution hold over a standard error."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from ..uncertainty.identifiability import ParameterInfluence
from . import levenberg_marquardt
from .objective import Objective


@dataclass(frozen=True)
class LinearityCriteria:
    """When tangents describe the motion.

    Attributes:
        max_relative_error: relative error of the tangents over a finite step above which errors do not use them.
        min_skew_error: the same error over one standard error, from which an interval is noticeably longer on one side.
        max_displacement_extents: displacement by a longest step, in extents of the cloth, above which tangents describe
            no motion.
        min_noticeable_stds: change of all data together, in standard deviations, below which a wrong slope can mislead
            no error bar.
        min_step_prior_stds: shortest finite step, in standard deviations of the prior.
        max_step_prior_stds: longest finite step, in standard deviations of the prior.
    """

    max_relative_error: float = 0.5
    min_skew_error: float = 0.2
    max_displacement_extents: float = 1.0
    min_noticeable_stds: float = 0.3
    min_step_prior_stds: float = 0.005
    max_step_prior_stds: float = 0.1


LINEARITY_CRITERIA = LinearityCriteria()


class FailedTangents(NamedTuple):
    """Tangents that do not hold over a finite step.

    Attributes:
        jacobian: [R, K] of the fabric's K unknowns.
        steps: [K] finite steps.
    """

    jacobian: Tensor
    steps: Tensor


class LinearityCheck(NamedTuple):
    """A solution whose derivatives hold, or have been replaced.

    Attributes:
        final: the solution.
        influence: how far each unknown moves the cloth.
        warnings: what a reader should know, in sentences.
        curved_parameters: names of unknowns whose interval may be skew.
        failure_reason: why tangents are of no use here. Empty where they are.
        covariance: [K, K] of the estimate, where it does not follow from the tangents.
        failed_tangents: the tangents that failed. None where they hold.
        unusable_parameters: names of unknowns whose tangents fail where those of others hold: these do not count as
            identified.
    """

    final: levenberg_marquardt.Iterate
    influence: ParameterInfluence
    warnings: list[str]
    curved_parameters: list[str]
    failure_reason: str = ""
    covariance: Tensor | None = None
    failed_tangents: FailedTangents | None = None
    unusable_parameters: tuple[str, ...] = ()

    @property
    def is_withdrawn(self) -> bool:
        """Whether no parameter counts as identified."""
        return bool(self.failure_reason)


def check_linearity(
    objective: Objective, final: levenberg_marquardt.Iterate, criteria: LinearityCriteria = LINEARITY_CRITERIA
) -> LinearityCheck:
    """Compare the tangents with finite steps of about a standard error, and replace those that fail by differences.

    Tangents are exact. Where the motion is unstable they describe a neighbourhood that is too small to matter. A
    parameter that moves the cloth less than ripples do may fail alone: its error is unknown, and that of others uses
    its finite slope.
    """
    prior = objective.problem().prior_std
    deviation = torch.zeros_like(prior)
    if not has_runaway_tangents(objective, final, criteria):  # else they give no covariance
        std = levenberg_marquardt.covariance(objective.problem(), final).diagonal().sqrt()
        deviation = torch.where(std.isfinite(), std, 0.0)  # where slopes overflow: the shortest steps
    shortest, longest = criteria.min_step_prior_stds * prior, criteria.max_step_prior_stds * prior
    steps = torch.minimum(torch.maximum(deviation, shortest), longest)[: len(objective.unknowns)]
    secants, influence = objective.linearise_by_differences(final.raw, steps)
    weight = final.row_weights()[0].sqrt()[:, None]
    secant, tangent = (weight * j[:, : len(steps)] for j in (secants.jacobian, final.linear.jacobian))
    squares = torch.stack([slopes.square().sum(0) for slopes in (secant, tangent, secant - tangent)])
    error = relative_error(squares, steps, criteria)
    if float(error.max()) < criteria.max_relative_error:
        over_one_std = error * deviation[: len(steps)] / steps
        pairs = zip(objective.unknowns, over_one_std, strict=True)
        curved = [u.name for u, skew in pairs if skew >= criteria.min_skew_error]
        return LinearityCheck(final, influence, [], curved)
    pairs = list(zip(objective.unknowns, error, strict=True))
    failing = [u.name for u, e in pairs if e >= criteria.max_relative_error]
    names, largest = ", ".join(failing), min(1000.0, 100 * float(error.max()))
    is_usable = not has_runaway_tangents(objective, final, criteria) and bool(secants.jacobian.isfinite().all())
    if is_usable and any(u.name not in failing for u in objective.unknowns if not u.measured):
        warning = f"tangents of {names} differ from finite steps by up to {largest:.0f} %: no estimate of {names}"
        jacobian = final.linear.jacobian.clone()
        fails = error >= criteria.max_relative_error
        jacobian[:, : len(steps)][:, fails] = secants.jacobian[:, : len(steps)][:, fails]
        linear = final.linear._replace(jacobian=jacobian)
        return LinearityCheck(
            final._replace(linear=linear), influence, [warning], [], unusable_parameters=tuple(failing)
        )
    reason = (
        f"the motion is unstable or strongly nonlinear at the solution (tangents of {names} differ from finite steps "
        f"by up to {largest:.0f} %)"
    )
    warning = f"{reason}: no parameter counts as identified"
    tangents = FailedTangents(final.linear.jacobian[:, : len(steps)], steps)
    return LinearityCheck(final._replace(linear=secants), influence, [warning], [], reason, None, tangents)


def relative_error(squares: Tensor, steps: Tensor, criteria: LinearityCriteria = LINEARITY_CRITERIA) -> Tensor:
    """Compute the relative errors [..., K] of tangents; zero where nobody would notice.

    Args:
        squares: [3, ..., K] sums of squares of the slopes over finite steps, of the tangents, and of their differences,
            in rows of unit variance.
        steps: [K].
        criteria: what is noticeable.
    """
    secant, tangent, difference = squares
    error = difference.sqrt() / secant.sqrt().clamp(min=1e-12)
    is_noticeable = ~(torch.maximum(secant, tangent).sqrt() * steps < criteria.min_noticeable_stds)
    error = torch.where(error.isfinite(), error, torch.inf)  # slopes that overflow say nothing
    return torch.where(is_noticeable, error, 0.0)


def has_runaway_tangents(
    objective: Objective, at: levenberg_marquardt.Iterate, criteria: LinearityCriteria = LINEARITY_CRITERIA
) -> bool:
    """Tell whether tangents are too long to describe a motion: a longest step moves the cloth by its own size."""
    is_position = torch.tensor([block.unit == "m" for block in objective.blocks])[at.linear.blocks]
    rows = at.linear.jacobian[is_position][:, : len(objective.unknowns)]
    if not len(rows):
        return False
    max_step = objective.problem().max_step[: len(objective.unknowns)]
    displacement = float((rows * max_step).square().mean(0).sqrt().max())
    return not displacement <= criteria.max_displacement_extents * objective.cloth.mesh.extent  # NaN runs away
