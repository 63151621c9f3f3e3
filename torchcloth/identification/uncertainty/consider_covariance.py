"""Covariance of a solution, with errors that were not fitted and yet widen the error bars (consider analysis).

The noise of a measured first shape is damped out, but not where grippers hold the cloth, and no gripper holds it
exactly where the recording says. A sheet that is held half a millimetre too far apart shows a force that makes its
stiffness seem some per cent larger.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ...boundaries import Grasp
from ...errors import SimulationDiverged, UnstableStep
from ..estimators import levenberg_marquardt
from ..estimators.linearity import LinearityCheck
from ..estimators.objective import Objective
from ..nuisances import GraspOffset
from .misfit import misfit_variance, split_residuals
from .replicates import MIN_REPLICATES, jackknife_variance

CONSIDERED_GRIP_STD_M = 1e-3  # by which a gripper holds the cloth beside the place that the recording says


def solution_covariance(objective: Objective, checked: LinearityCheck, strata: Tensor | None = None) -> Tensor:
    """Compute the covariance [K, K] of a solution, grasp offsets and the scatter between episodes included.

    Args:
        objective: of the frames that were used.
        checked: the solution.
        strata: [E] groups of replicates (``replicates.assign_strata``); None: all episodes are one group.
    """
    final = checked.final
    problem, count = objective.problem(), len(objective.episodes)
    sampled = checked.covariance
    covariance = levenberg_marquardt.covariance(problem, final) if sampled is None else sampled
    episode = objective.episode_of_rows(final.linear)
    variances = covariance.diagonal() + misfit_variance(problem, final, episode, shared_misfit(objective, final))
    covariance = levenberg_marquardt.inflate_covariance(covariance, variances)
    if count >= MIN_REPLICATES:
        strata = torch.zeros(count, dtype=torch.int64) if strata is None else strata
        scatter = jackknife_variance(problem, final, episode, strata)
        scatter[len(objective.unknowns) :] = 0.0  # without its episode a nuisance has no data, and no scatter
        covariance = levenberg_marquardt.inflate_covariance(covariance, scatter)
    if checked.is_withdrawn:  # a withdrawn solution is not used
        return covariance
    if sampled is None and not final.converged:  # a search that was cut short is as uncertain as the remaining step
        gradient, hessian = levenberg_marquardt.normal_equations(problem, final)
        moves = torch.ones(len(gradient), dtype=torch.bool)
        moves[: len(objective.unknowns)] = torch.tensor(
            [u.name not in checked.unusable_parameters for u in objective.unknowns]
        )
        remaining = torch.zeros_like(gradient)
        remaining[moves] = torch.linalg.solve(hessian[moves][:, moves], gradient[moves])
        variances = covariance.diagonal() + remaining.square()
        covariance = levenberg_marquardt.inflate_covariance(covariance, variances)
    return add_initial_shape_noise(objective, final, covariance, by_tangents=sampled is None)


def shared_misfit(objective: Objective, at: levenberg_marquardt.Iterate) -> Tensor:
    """Compute the mean square [B] of the misfit that readings of a part of the fabric share, for every block.

    Where the noise of the points is stated, it includes what is slow, and only what exceeds it is misfit.
    """
    split = split_residuals(at, objective.episode_of_rows(at.linear))
    stated = torch.tensor([objective.stated_noise(b) for b in objective.blocks]).to(split.total)[: len(split.total)]
    excess = (split.total - stated.square()).clamp(min=0.0)
    return torch.where(stated > 0, torch.minimum(split.shared, excess), split.shared)


def points_misfit(objective: Objective, at: levenberg_marquardt.Iterate) -> float | None:
    """Compute the root mean square misfit [m] that points of a part of the fabric share; None without points."""
    for index, block in enumerate(objective.blocks[: len(at.scale)]):
        if block.name == "points":
            return float(shared_misfit(objective, at)[index].sqrt())
    return None


def add_initial_shape_noise(
    objective: Objective, final: levenberg_marquardt.Iterate, covariance: Tensor, by_tangents: bool = True
) -> Tensor:
    """Widen a covariance [K, K] by the noise of the held vertices, as a considered parameter (Schmidt 1966).

    Nothing is added where the offset was fitted, or where the first shape is not measured.

    Args:
        objective: of the frames that were used.
        final: the solution.
        covariance: [K, K] of it.
        by_tangents: take slopes from tangents; else from steps of one standard deviation, which mean something where
            the motion is unstable, too.
    """
    wider, is_considered = with_grasp_offsets(objective)
    if wider is objective:
        return covariance
    raw = wider.start.clone()
    raw[~is_considered] = final.raw
    considered = is_considered.nonzero().squeeze(-1).tolist()
    if by_tangents:
        slopes = wider.linearise_first_shape(raw).jacobian[:, considered]
    else:
        here = wider.evaluate_all(raw).residual
        slopes = torch.stack([_finite_slope(wider, raw, k, here) for k in considered], 1)
    weighted = final.row_weights()[0][:, None] * final.linear.jacobian
    information = levenberg_marquardt.information_matrix(objective.problem(), final)
    sensitivity = torch.linalg.solve(information, weighted.mT @ slopes) * wider.prior_std[is_considered]
    return covariance + sensitivity @ sensitivity.mT


def _finite_slope(objective: Objective, raw: Tensor, k: int, here: Tensor) -> Tensor:
    """[R] change of residuals ``here`` by a unit of unknown ``k``, over its prior std; zero where that diverges."""
    step = float(objective.prior_std[k])
    shifted = raw.clone()
    shifted[k] += step
    try:
        return (objective.evaluate_all(shifted).residual - here) / step
    except (SimulationDiverged, UnstableStep):
        return torch.zeros_like(here)


def with_grasp_offsets(objective: Objective) -> tuple[Objective, Tensor]:
    """Add offsets of the grasps to the unknowns of an objective.

    Each held vertex is taken to carry the noise of one point, and each grip an error of its own.

    Returns:
        The wider objective, and which of its unknowns [K] are these offsets. The objective itself where the offset is
        fitted, or where the first shape is not measured.
    """
    is_fitted = any(nuisance.name == GraspOffset.name for nuisance in objective.nuisances)
    vertex_counts = [len(part.index) for part in objective.cloth.boundaries.values() if isinstance(part, Grasp)]
    noises = [e.noise_std or 0.0 for e in objective.episodes if e.is_first_shape_measured]
    if is_fitted or not vertex_counts or not noises:
        return objective, torch.zeros(len(objective.start), dtype=torch.bool)
    offset = GraspOffset(math.hypot(CONSIDERED_GRIP_STD_M, max(noises) / min(vertex_counts) ** 0.5))
    wider = objective.with_nuisances([*objective.nuisances, offset])
    is_considered = torch.zeros(len(wider.start), dtype=torch.bool)
    for slices in wider.nuisance_slices:
        for s in slices:
            is_considered[s.index] = s.nuisance.name == GraspOffset.name
    return wider, is_considered
