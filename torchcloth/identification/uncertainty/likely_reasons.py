"""What would explain a misfit: errors of a recording that were not fitted, and how much of it each would remove.

Each kind of error is linearised at the solution and fitted to the residuals together with the parameters, against a
wide prior. Its share is the decrease of the weighted sum of squares, less what as many numbers would remove of noise.

A grip may be off, and it may yield: then it holds less than the recording says. How much it holds is no smooth number.
Its direction is the difference that a hinge makes, where each gripper holds the innermost vertices of its patch alone.
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
LARGE_LAG_S, LARGE_JITTER_S = 0.05, 0.03
LARGE_CAMERA_ERROR_M, LARGE_GRIP_ERROR_M, LARGE_SHAPE_ERROR_M = 5e-3, 5e-3, 1e-2
LARGE_YIELD = 1.0  # of the way from a clamp to a hinge
JITTER = "jitter"
REASON_WORDS = {
    "clock": "a lag of the stamps, or a grip that yields",
    JITTER: "single stamps that are off",
    "camera": "the camera's pose",
    "grasp": "the grip",
    "shape": "the first shape",
}
REASON_REMEDIES = {name: f"--nuisance {name} fits it" for name in REASON_WORDS if name != JITTER} | {
    "grasp": "--nuisance grasp fits where it is; if it turns as a hinge, state a smaller radius"
}
REASONS_LEAD = "likeliest reasons, by the share of the misfit that each explains: "
MIN_REASON_SHARE = 0.15  # of the misfit, from which a reason is named
MIN_EQUAL_SHARE_RATIO = 0.8  # of a share to the largest one, from which a reason is as likely


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
    hinge = _effect_of_hinges(objective, final, linear.residual)

    def decrease(columns: Tensor, with_hinge: bool) -> float:
        jacobian, precision = linear.jacobian[:, columns], wider.prior_std[columns] ** -2
        if with_hinge:
            jacobian = torch.cat([jacobian, hinge[:, None]], 1)
            precision = torch.cat([precision, precision.new_tensor([LARGE_YIELD**-2])])
        return _decrease(jacobian, linear.residual, weight, precision)

    reasons, without = [], decrease(is_fitted, with_hinge=False)
    for name in dict.fromkeys([*(candidate.name for candidate in candidates), GraspOffset.name]):
        columns = is_fitted | torch.tensor([column == name for column in names])
        gain = decrease(columns, with_hinge=name == GraspOffset.name) - without
        reasons.append(Reason(name, gain / total))
    for nuisance in [n for n in wider.nuisances if n.name == ClockOffset.name]:
        clock = linear.jacobian[:, torch.tensor([name == nuisance.name for name in names])].sum(1)
        reasons.append(Reason(JITTER, _jitter_decrease(clock, linear.residual, weight, linear.frame) / total))
    return sorted(reasons, key=lambda reason: -reason.share)


def describe_reasons(reasons: Sequence[Reason]) -> str:
    """Return a sentence about the likeliest reasons of a misfit."""
    named = [reason for reason in reasons if reason.share >= MIN_REASON_SHARE]
    if not named:
        return "none of lag, grip, first shape and camera explains it; `torchcloth diagnose` looks for what is missing"
    shares = ", ".join(f"{REASON_WORDS[reason.name]} ({100 * reason.share:.0f} %)" for reason in named)
    as_likely = [reason for reason in named if reason.share > MIN_EQUAL_SHARE_RATIO * named[0].share]
    remedies = [REASON_REMEDIES[reason.name] for reason in as_likely if reason.name in REASON_REMEDIES]
    return "; ".join([f"{REASONS_LEAD}{shares}", *remedies])


def hold_innermost(cloth: Cloth) -> Cloth:
    """Return the cloth with every grasp reduced to the innermost of its vertices, which are farthest from free ones.

    Rings of vertices that share a triangle with a free one are taken away, as long as any are left.
    """
    faces = torch.as_tensor(cloth.mesh.faces).long()
    boundaries = {name: part.with_vertices(_innermost(part.index, faces)) for name, part in _grasps(cloth).items()}
    return rebuild_cloth(cloth, {}, None, boundaries)


def _innermost(gripped: Tensor, faces: Tensor) -> Tensor:
    """Innermost of gripped vertices [H] in triangles [F, 3]."""
    while True:
        is_gripped = torch.isin(faces, gripped)
        inner = gripped[~torch.isin(gripped, faces[~is_gripped.all(1)])]
        if len(inner) in (0, len(gripped)):  # no ring is left, or a whole piece of cloth is gripped
            return gripped
        gripped = inner


def _effect_of_hinges(objective: Objective, final: levenberg_marquardt.Iterate, residual: Tensor) -> Tensor:
    """Change of the residuals [R] at the solution if grippers hold as hinges; 0 where that is no other stable model."""
    before, cloth = _grasps(objective.cloth), hold_innermost(objective.cloth)
    if all(torch.equal(part.index, before[name].index) for name, part in _grasps(cloth).items()):
        return torch.zeros_like(residual)
    try:
        hinged = objective.with_cloth(cloth).evaluate(final.raw)[0]
    except (SimulationDiverged, UnstableStep):
        return torch.zeros_like(residual)
    if len(hinged) != len(residual):  # along the rim other points may count: no change is known then
        return torch.zeros_like(residual)
    is_missing = (hinged == 0) | (residual == 0)  # a piece of the rim that was not seen
    return torch.where(is_missing, 0.0, hinged - residual)


def _grasps(cloth: Cloth) -> dict[str, Grasp]:
    return {name: part for name, part in cloth.boundaries.items() if isinstance(part, Grasp)}


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
