"""The rigid-carry null: cloth that moves with the grippers undeformed. A fit that does not beat it is worthless."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ...boundaries.motion import interpolate
from ...episodes.observed import Episode
from ...episodes.replay import Frames
from ..estimators.objective import Objective
from .metrics import figures, forces_rms

STILL = 1e-3  # m, that cloth moves with grippers that stand
WORSE = 1.5  # times as far from what was seen as cloth that stays where it lay, from which a fit tells nothing
STAYS, CARRIED, UNFELT = "cloth that stays where it lay", "cloth carried rigidly by the grippers", "no force at all"
ARM = 0.05  # m, length of the axes that carry a gripper's orientation into the alignment


def rigid_carry(episode: Episode) -> Tensor:
    """Frames [T, V, 3] m of the initial shape under the rigid motion that best follows all grippers."""
    times = episode.times
    marks = [_marks(interpolate(trajectory, times)) for trajectory in episode.motion.values()]
    if not marks:
        return episode.initial.expand(len(times), -1, -1)
    rotation, shift = _align(torch.cat(marks, dim=1))
    return episode.initial @ rotation.mT + shift.unsqueeze(-2)


def no_force(episode: Episode) -> dict[str, Tensor]:
    """Grippers that feel nothing, as ``Episode.wrenches``."""
    return {name: torch.zeros_like(wrench) for name, wrench in episode.wrenches.items()}


def constant_force(episode: Episode) -> dict[str, Tensor]:
    """Each gripper's mean reading, which a weight alone would give."""
    return {name: wrench.nanmean(0).expand_as(wrench) for name, wrench in episode.wrenches.items()}


def no_better_than(objective: Objective, frames: Sequence[Frames]) -> str:
    """The null that ``frames`` of the objective's episodes do not beat, in words; empty where they do or none exists.

    By distance to what was seen while grippers moved, else by force. Cloth that hangs still lies where it lay at first,
    whatever it is made of; but not far from there.
    """
    if objective.uses("points", "markers"):
        rigid = [rigid_carry(e) for e in objective.episodes]
        moved = [k for k, x in enumerate(rigid) if float((x - x[:1]).abs().max()) > STILL]
        seen = [objective.episodes[k] for k in moved]
        own, null = (figures([x[k] for k in moved], seen, objective.faces) for x in ([f.x for f in frames], rigid))
        if not math.isnan(own.chamfer):
            return CARRIED if own.chamfer >= null.chamfer else ""
        if not moved:
            own, null = (figures(x, objective.episodes, objective.faces) for x in ([f.x for f in frames], rigid))
            if own.chamfer > WORSE * null.chamfer:
                return STAYS
    if objective.uses("force") and any(e.wrenches for e in objective.episodes):
        felt = forces_rms([f.wrench for f in frames], objective.episodes)
        return UNFELT if felt >= forces_rms([no_force(e) for e in objective.episodes], objective.episodes) else ""
    return ""


def _marks(pose: Tensor) -> Tensor:
    """[T, 7, 3] m: a gripper's origin and points on its axes."""
    tips = ARM * torch.cat([torch.zeros(1, 3), torch.eye(3), -torch.eye(3)]).to(pose)
    return tips @ pose[:, :3, :3].mT + pose[:, None, :3, 3]


def _align(marks: Tensor) -> tuple[Tensor, Tensor]:
    """Rotations [T, 3, 3] and translations [T, 3] that carry the first frame's marks to each frame's (Kabsch)."""
    centre = marks.mean(1, keepdim=True)
    moved = marks - centre
    U, _, Vt = torch.linalg.svd(moved.mT @ moved[:1].expand_as(moved))
    sign = torch.linalg.det(U @ Vt)
    fix = torch.diag_embed(torch.stack([torch.ones_like(sign), torch.ones_like(sign), sign], dim=-1))
    rotation = U @ fix @ Vt
    return rotation, centre.squeeze(1) - (rotation @ centre[0].mT).squeeze(-1)
