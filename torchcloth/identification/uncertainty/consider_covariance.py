"""Errors that were not fitted, and yet widen the error bars.

Where grippers hold the cloth, the noise of a measured first shape stays: it is not damped out as elsewhere. A sheet
that is held half a millimetre too far apart shows a force from which its stiffness seems some per cent larger.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ...boundaries import Grasp
from ..estimators import levenberg_marquardt
from ..estimators.linearity import Checked
from ..estimators.objective import Objective
from ..nuisances import Held
from .replicates import FEWEST, scatter


def covariance_of(objective: Objective, checked: Checked, strata: Tensor | None = None) -> Tensor:
    """[K, K] of a solution, held places and episodes' scatter included; ``strata`` [E]: ``replicates.strata_of``."""
    final = checked.final
    problem, count = objective.problem(), len(objective.episodes)
    known = checked.covariance
    own = levenberg_marquardt.covariance(problem, final) if known is None else known
    if count >= FEWEST:
        strata = torch.zeros(count, dtype=torch.int64) if strata is None else strata
        spread = scatter(problem, final, objective.episode_of(final.linear), strata)
        spread[len(objective.unknowns) :] = 0.0  # an episode's own nuisance is lost without it, and scatters nowhere
        own = levenberg_marquardt.at_least(own, spread)
    if known is not None or checked.withdrawn:  # of what is withdrawn nothing will be used
        return own
    if not final.converged:  # the answer of a search that was cut short is as uncertain as the way that is left
        gradient, hessian = levenberg_marquardt.normal_equations(problem, final)
        left = torch.linalg.solve(hessian, gradient)
        own = levenberg_marquardt.at_least(own, own.diagonal() + left.square())
    return with_first_shape(objective, final, own)


def with_first_shape(objective: Objective, final: levenberg_marquardt.Iterate, covariance: Tensor) -> Tensor:
    """The covariance [K, K] widened by the noise of the held places, as a considered parameter (Schmidt 1966).

    Nothing is added where the offset was fitted, or where the first shape or its noise are not measured.
    """
    wider, considered = with_held_places(objective)
    if wider is objective:
        return covariance
    raw = wider.start.clone()
    raw[~considered] = final.raw
    slopes = wider.linearise(raw).jacobian[:, considered]
    weighted = final.influence()[0][:, None] * final.linear.jacobian
    moved = torch.linalg.solve(levenberg_marquardt.information(objective.problem(), final), weighted.mT @ slopes)
    moved = moved * wider.prior_std[considered]
    return covariance + moved @ moved.mT


def with_held_places(objective: Objective) -> tuple[Objective, Tensor]:
    """The same with offsets of the held places among the unknowns, and which of those [K] these are.

    Each held vertex is taken to carry the noise of one point. The objective itself where the offset is fitted, or where
    the first shape or its noise are not measured.
    """
    fitted = any(nuisance.name == Held.name for nuisance in objective.nuisances)
    held = [len(part.index) for part in objective.cloth.boundaries.values() if isinstance(part, Grasp)]
    noises = [e.noise if e.settles and e.noise else 0.0 for e in objective.episodes]
    if fitted or not held or max(noises) == 0.0:
        return objective, torch.zeros(len(objective.start), dtype=torch.bool)
    wider = objective.beside([*objective.nuisances, Held(max(noises) / min(held) ** 0.5)])
    considered = torch.zeros(len(wider.start), dtype=torch.bool)
    for own in wider.placed:
        for p in own:
            considered[p.where] = p.nuisance.name == Held.name
    return wider, considered
