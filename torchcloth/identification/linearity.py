"""Whether the derivatives at the solution hold over a standard error."""

from __future__ import annotations

from typing import NamedTuple

import torch

from . import gauss_newton
from .identifiability import Reach
from .objective import Objective

NONLINEAR = 0.5  # relative error of the tangents over a finite step above which they are not used for errors
CURVED = 0.2  # the same over a standard error, from which an interval is noticeably longer to one side
SMALLEST, LARGEST = 0.005, 0.1  # finite steps, in units of the prior's standard deviation
UNSEEN = 0.01  # error over a finite step, in standard deviations of all data together, below which nobody sees it


class Checked(NamedTuple):
    """A solution whose derivatives hold, or have been replaced."""

    final: gauss_newton.Iterate
    reach: Reach
    warnings: list[str]
    curved: list[str]  # unknowns whose interval may be skew


def check(objective: Objective, final: gauss_newton.Iterate) -> Checked:
    """Compare the tangents with finite steps of about a standard error; where they fail, differences replace them.

    Tangents are exact, but where the motion is unstable they describe a neighbourhood too small to matter.
    """
    deviation = gauss_newton.covariance(objective.problem(), final).diagonal().sqrt()
    prior = objective.problem().prior_std
    steps = torch.minimum(torch.maximum(deviation, SMALLEST * prior), LARGEST * prior)[: len(objective.unknowns)]
    secants, reach = objective.secants(final.raw, steps)
    weight = final.influence()[0].sqrt()[:, None]
    moved, slope = (weight * j[:, : len(steps)] for j in (secants.jacobian, final.linear.jacobian))
    apart = (moved - slope).norm(dim=0)
    seen = apart * steps > UNSEEN  # else of a parameter without effect, whose finite step moves the last digits only
    missed = torch.where(seen, apart / moved.norm(dim=0).clamp(min=1e-12), 0.0)
    if float(missed.max()) < NONLINEAR:
        over_one = missed * deviation[: len(steps)] / steps
        curved = [u.name for u, error in zip(objective.unknowns, over_one, strict=True) if error >= CURVED]
        return Checked(final, reach, [], curved)
    names = ", ".join(u.name for u, error in zip(objective.unknowns, missed, strict=True) if error >= NONLINEAR)
    warning = (
        f"the motion is unstable or strongly nonlinear at the solution (tangents of {names} miss finite steps "
        f"by up to {min(1000.0, 100 * float(missed.max())):.0f} %): no parameter counts as identified"
    )
    return Checked(final._replace(linear=secants), reach, [warning], [])
