"""Whether the derivatives at the solution hold over a standard error."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ..uncertainty.identifiability import Reach
from . import levenberg_marquardt
from .objective import Objective

NONLINEAR = 0.5  # relative error of the tangents over a finite step above which they are not used for errors
CURVED = 0.2  # the same over a standard error, from which an interval is noticeably longer to one side
RUNAWAY = 1.0  # sizes of the cloth
NOTICED = 0.3  # standard deviations of all data together: what moves them less can mislead no error bar
SMALLEST, LARGEST = 0.005, 0.1  # finite steps, in units of the prior's standard deviation


class Checked(NamedTuple):
    """A solution whose derivatives hold, or have been replaced."""

    final: levenberg_marquardt.Iterate
    reach: Reach
    warnings: list[str]
    curved: list[str]  # unknowns whose interval may be skew
    reason: str = ""  # why tangents are of no use here; empty where they are
    covariance: Tensor | None = None  # [K, K] of the estimate, where it is not that of the tangents

    @property
    def withdrawn(self) -> bool:
        """Whether no parameter counts as identified."""
        return bool(self.reason)


def check(objective: Objective, final: levenberg_marquardt.Iterate) -> Checked:
    """Compare the tangents with finite steps of about a standard error; where they fail, differences replace them.

    Tangents are exact, but where the motion is unstable they describe a neighbourhood too small to matter.
    """
    prior = objective.problem().prior_std
    deviation = torch.zeros_like(prior)
    if not runaway(objective, final):  # else their covariance is none
        found = levenberg_marquardt.covariance(objective.problem(), final).diagonal().sqrt()
        deviation = torch.where(found.isfinite(), found, 0.0)  # else slopes that overflow: the smallest steps
    steps = torch.minimum(torch.maximum(deviation, SMALLEST * prior), LARGEST * prior)[: len(objective.unknowns)]
    secants, reach = objective.secants(final.raw, steps)
    weight = final.influence()[0].sqrt()[:, None]
    moved, slope = (weight * j[:, : len(steps)] for j in (secants.jacobian, final.linear.jacobian))
    missed = (moved - slope).norm(dim=0) / moved.norm(dim=0).clamp(min=1e-12)
    noticed = ~(torch.maximum(moved.norm(dim=0), slope.norm(dim=0)) * steps < NOTICED)
    missed = torch.where(missed.isfinite(), missed, torch.inf)  # slopes that overflow say nothing
    missed = torch.where(noticed, missed, 0.0)
    if float(missed.max()) < NONLINEAR:
        over_one = missed * deviation[: len(steps)] / steps
        curved = [u.name for u, error in zip(objective.unknowns, over_one, strict=True) if error >= CURVED]
        return Checked(final, reach, [], curved)
    names = ", ".join(u.name for u, error in zip(objective.unknowns, missed, strict=True) if error >= NONLINEAR)
    reason = (
        f"the motion is unstable or strongly nonlinear at the solution (tangents of {names} miss finite steps "
        f"by up to {min(1000.0, 100 * float(missed.max())):.0f} %)"
    )
    warning = f"{reason}: no parameter counts as identified"
    return Checked(final._replace(linear=secants), reach, [warning], [], reason)


def runaway(objective: Objective, at: levenberg_marquardt.Iterate) -> bool:
    """Whether tangents are so long that they describe no motion: a longest step by many times the cloth's size."""
    seen = torch.tensor([block.unit == "m" for block in objective.blocks])[at.linear.kind]
    rows = at.linear.jacobian[seen][:, : len(objective.unknowns)]
    longest = objective.problem().longest[: len(objective.unknowns)]
    return (
        bool(len(rows))
        and not float((rows * longest).square().mean(0).sqrt().max()) <= RUNAWAY * objective.cloth.mesh.extent
    )
