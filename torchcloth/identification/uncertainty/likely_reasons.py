"""What would explain a misfit: errors of a recording that were not fitted, and how much of it each would remove.

Each kind of error is linearised at the solution and fitted to the residuals together with the parameters, against a
wide prior. Its share is the decrease of the weighted sum of squares, less what as many numbers would remove of noise.

A grip that yields has no slope: it holds fewer vertices than the recording says. Its direction is the difference that
the end of this range makes, where each gripper holds the innermost vertices of its patch alone, as a hinge does.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ...boundaries import Grasp
from ...cloth import Cloth
from ...episodes.world import rebuild_cloth
from ...errors import SimulationDiverged, UnstableStep
from ..estimators import levenberg_marquardt
from ..estimators.objective import Objective
from ..nuisances import AbstractNuisance, CameraOffset, ClockOffset, GraspOffset, InitialShapeOffset

# Standard deviations of wide priors: a reason may be a large error.
LARGE_LAG_S, LARGE_CAMERA_ERROR_M, LARGE_GRIP_ERROR_M, LARGE_SHAPE_ERROR_M, LARGE_JITTER_S = (
    0.05,
    5e-3,
    5e-3,
    1e-2,
    0.03,
)
LARGE_YIELD = 1.0  # of the way from a clamp to a hinge
JITTER, YIELDING_GRIP = "jitter", "yielding grip"
REASON_WORDS = {
    "clock": "a lag of the stamps",
    YIELDING_GRIP: "the grip, which yields or turns as a hinge",
    JITTER: "single stamps that are off",
    "camera": "the camera's pose",
    "grasp": "the grip",
    "shape": "the first shape",
}
REASON_REMEDIES = {name: f"--nuisance {name}" for name in REASON_WORDS if name not in (JITTER, YIELDING_GRIP)}
MIN_REASON_SHARE = 0.15  # of the misfit, from which a reason is named


class Reason(NamedTuple):
    """One kind of error.

    Attributes:
        name: of the nuisance, or "jitter".
        share: of the weighted sum of squares of the residuals that it would remove.
    """

    name: str
    share: float


def rank_reasons(objective: Objective, final: levenberg_marquardt.Iterate) -> list[Reason]:
    """Return the reasons, the largest share first.

    Args:
        objective: of the frames that were used.
        final: the solution.
    """
    fitted = {nuisance.name for nuisance in objective.nuisances}
    candidates: list[AbstractNuisance] = [
        kind(std)
        for kind, std in (
            (ClockOffset, LARGE_LAG_S),
            (CameraOffset, LARGE_CAMERA_ERROR_M),
            (GraspOffset, LARGE_GRIP_ERROR_M),
            (InitialShapeOffset, LARGE_SHAPE_ERROR_M),
        )
        if kind.name not in fitted
    ]
    wider = objective.with_nuisances([*objective.nuisances, *candidates])
    names = _column_names(wider)
    is_fitted = torch.tensor([name in fitted or not name for name in names])
    raw = wider.start.clone()
    raw[is_fitted] = final.raw
    linear = wider.linearise(raw)
    weight = final.row_weights()[0]
    total = float((weight * linear.residual.square()).sum())
    if not total > 0:
        return []
    reasons = []
    for candidate in candidates:
        columns = is_fitted | torch.tensor([name == candidate.name for name in names])
        precision = wider.prior_std[columns] ** -2
        without = wider.prior_std[is_fitted] ** -2
        gain = _decrease(linear.jacobian[:, columns], linear.residual, weight, precision)
        gain -= _decrease(linear.jacobian[:, is_fitted], linear.residual, weight, without)
        reasons.append(Reason(candidate.name, gain / total))
    hinged = _residuals_of_hinges(objective, final)
    if hinged is not None:
        fitted_columns = linear.jacobian[:, is_fitted]
        is_missing = (hinged == 0) | (linear.residual == 0)  # a piece of the rim that was not seen
        column = torch.where(is_missing, 0.0, hinged - linear.residual)[:, None]
        without = wider.prior_std[is_fitted] ** -2
        precision = torch.cat([without, without.new_tensor([LARGE_YIELD**-2])])
        gain = _decrease(torch.cat([fitted_columns, column], 1), linear.residual, weight, precision)
        gain -= _decrease(fitted_columns, linear.residual, weight, without)
        reasons.append(Reason(YIELDING_GRIP, gain / total))
    for nuisance in [n for n in wider.nuisances if n.name == ClockOffset.name]:
        clock = linear.jacobian[:, torch.tensor([name == nuisance.name for name in names])].sum(1)
        reasons.append(Reason(JITTER, _jitter_decrease(clock, linear.residual, weight, linear.frame) / total))
    return sorted(reasons, key=lambda reason: -reason.share)


def describe_reasons(reasons: Sequence[Reason]) -> str:
    """Return a sentence about what would explain most of a misfit."""
    named = [reason for reason in reasons if reason.share >= MIN_REASON_SHARE]
    if not named:
        return "none of lag, grip, first shape and camera explains it; `torchcloth diagnose` looks for what is missing"
    shares = ", ".join(f"{REASON_WORDS[reason.name]} ({100 * reason.share:.0f} %)" for reason in named)
    remedy = REASON_REMEDIES.get(named[0].name, "")
    return f"what would explain most of it: {shares}" + (f"; {remedy} fits it" if remedy else "")


def hold_innermost(cloth: Cloth) -> Cloth:
    """Return the cloth with every grasp reduced to the innermost of its vertices, which are farthest from free ones.

    Rings of vertices that share a triangle with a free one are taken away, as long as any are left.
    """
    boundaries = {
        name: part.with_vertices(_innermost(part.index, torch.as_tensor(cloth.mesh.faces).long()))
        for name, part in cloth.boundaries.items()
        if isinstance(part, Grasp)
    }
    return rebuild_cloth(cloth, {}, None, boundaries)


def _innermost(held: Tensor, faces: Tensor) -> Tensor:
    """Innermost of the vertices [H], which are gripped, of triangles [F, 3]."""
    inner = held
    while len(inner):
        held, is_held = inner, torch.isin(faces, inner)
        inner = held[~torch.isin(held, faces[~is_held.all(1)])]
        if len(inner) == len(held):  # all of a piece is gripped
            break
    return held


def _residuals_of_hinges(objective: Objective, final: levenberg_marquardt.Iterate) -> Tensor | None:
    """Residuals [R] at the solution where grippers hold as hinges; None where that is no other or no stable model."""
    cloth = hold_innermost(objective.cloth)
    grasps = {name: part for name, part in cloth.boundaries.items() if isinstance(part, Grasp)}
    if all(torch.equal(part.index, objective.cloth.boundaries[name].index) for name, part in grasps.items()):
        return None
    try:
        residual = objective.with_cloth(cloth).evaluate(final.raw)[0]
    except (SimulationDiverged, UnstableStep):
        return None
    return residual if len(residual) == len(final.linear.residual) else None


def _column_names(objective: Objective) -> list[str]:
    """Name of the nuisance of every unknown [K]; empty for the fabric's."""
    names = [""] * len(objective.start)
    for slices in objective.nuisance_slices:
        for s in slices:
            names[s.index] = [s.nuisance.name] * (s.index.stop - s.index.start)
    return names


def _decrease(jacobian: Tensor, residual: Tensor, weight: Tensor, precision: Tensor) -> float:
    """Decrease of the weighted sum of squares at its minimum, less what noise alone would give."""
    information = jacobian.mT @ (weight[:, None] * jacobian)
    hessian = information + torch.diag(precision)
    gradient = jacobian.mT @ (weight * residual)
    freedom = torch.linalg.solve(hessian, information).trace()
    return float(gradient @ torch.linalg.solve(hessian, gradient) - freedom)


def _jitter_decrease(clock: Tensor, residual: Tensor, weight: Tensor, frame: Tensor) -> float:
    """The same for an error of every frame's stamp, each on its own."""
    count = int(frame.max()) + 1
    information = clock.new_zeros(count).index_add(0, frame, weight * clock.square())
    gradient = clock.new_zeros(count).index_add(0, frame, weight * clock * residual)
    hessian = information + LARGE_JITTER_S**-2
    return float((gradient.square() / hessian - information / hessian).sum())
