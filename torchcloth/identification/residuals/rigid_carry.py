"""The rigid-carry baseline: cloth that moves with the grippers undeformed. A fit must be better than that."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ...boundaries.motion import interpolate_poses
from ...episodes.observed import Episode
from ...episodes.replay import Frames
from ..estimators.objective import Objective
from .metrics import distance_metrics, force_rms

MIN_GRIPPER_MOTION_M = 1e-3  # displacement of carried cloth, below which grippers stand still
MAX_DISTANCE_OVER_STATIC = 1.5  # distance from the data over that of static cloth, beyond which a fit says nothing
STATIC_NULL, CARRIED_NULL, ZERO_FORCE_NULL = (
    "cloth that stays where it lay",
    "cloth carried rigidly by the grippers",
    "no force at all",
)
GRIPPER_AXIS_LENGTH_M = 0.05  # of the axes that carry a gripper's orientation into the alignment


def carry_rigidly(episode: Episode) -> Tensor:
    """Return frames [T, V, 3] m of the initial shape under the rigid motion that best follows all grippers."""
    times = episode.times
    markers = [_gripper_points(interpolate_poses(trajectory, times)) for trajectory in episode.motion.values()]
    if not markers:
        return episode.initial.expand(len(times), -1, -1)
    rotation, shift = _align(torch.cat(markers, dim=1))
    return episode.initial @ rotation.mT + shift.unsqueeze(-2)


def zero_forces(episode: Episode) -> dict[str, Tensor]:
    """Return wrenches of zero for every gripper that measures, as ``Episode.wrenches``."""
    return {name: torch.zeros_like(wrench) for name, wrench in episode.wrenches.items()}


def mean_forces(episode: Episode) -> dict[str, Tensor]:
    """Return each gripper's mean reading at all frames: a weight alone would read that."""
    return {name: wrench.nanmean(0).expand_as(wrench) for name, wrench in episode.wrenches.items()}


def find_unbeaten_null(objective: Objective, frames: Sequence[Frames]) -> str:
    """Return the baseline that a simulation does not beat, in words; empty where it beats it or none exists.

    The distance to the data while grippers moved decides, else the forces. Cloth that hangs still lies where it lay at
    first, whatever it is made of, but not far from there.

    Args:
        objective: with the data.
        frames: the simulation of its episodes.
    """
    episodes, faces = objective.episodes, objective.faces
    if objective.uses("points", "markers"):
        simulated, rigid = [f.x for f in frames], [carry_rigidly(e) for e in episodes]
        moving = [k for k, x in enumerate(rigid) if float((x - x[:1]).abs().max()) > MIN_GRIPPER_MOTION_M]
        moving_episodes = [episodes[k] for k in moving]
        fit, null = (distance_metrics([x[k] for k in moving], moving_episodes, faces) for x in (simulated, rigid))
        if not math.isnan(fit.chamfer):
            return CARRIED_NULL if fit.chamfer >= null.chamfer else ""
        if not moving:
            fit, null = (distance_metrics(x, episodes, faces) for x in (simulated, rigid))
            if fit.chamfer > MAX_DISTANCE_OVER_STATIC * null.chamfer:
                return STATIC_NULL
    if objective.uses("force") and any(e.wrenches for e in episodes):
        error = force_rms([f.wrench for f in frames], episodes)
        return ZERO_FORCE_NULL if error >= force_rms([zero_forces(e) for e in episodes], episodes) else ""
    return ""


def _gripper_points(pose: Tensor) -> Tensor:
    """[T, 7, 3] m: a gripper's origin and points on its axes."""
    points = GRIPPER_AXIS_LENGTH_M * torch.cat([torch.zeros(1, 3), torch.eye(3), -torch.eye(3)]).to(pose)
    return points @ pose[:, :3, :3].mT + pose[:, None, :3, 3]


def _align(points: Tensor) -> tuple[Tensor, Tensor]:
    """Rotations [T, 3, 3] and translations [T, 3] from the first frame's points to each frame's (Kabsch)."""
    centre = points.mean(1, keepdim=True)
    centred = points - centre
    U, _, Vt = torch.linalg.svd(centred.mT @ centred[:1].expand_as(centred))
    sign = torch.linalg.det(U @ Vt)
    reflection = torch.diag_embed(torch.stack([torch.ones_like(sign), torch.ones_like(sign), sign], dim=-1))
    rotation = U @ reflection @ Vt
    return rotation, centre.squeeze(1) - (rotation @ centre[0].mT).squeeze(-1)
