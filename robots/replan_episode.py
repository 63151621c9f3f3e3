"""Joint motions by which the arms of an episode follow the paths of its grippers."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from torchcloth.errors import InvalidInput
from torchcloth.recordings import Collider, Recording
from torchcloth.types import Trajectory

from .paths import holding_paths
from .plan import JointPlan, plan
from .primitives import Action
from .replay import arm_from_recording, replay
from .scene import Scene, Table

TABLE_MARGIN_M = 0.1  # by which a table extends beyond cloth and paths; an episode gives only its plane
MIN_TABLE_NORMAL_Z = 0.97  # vertical part of a unit normal; a steeper plane is no table


def scene_from_episode(recording: Recording) -> Scene | None:
    """Return the arms of the grippers that hold the cloth, and the table; None if one of them has no arm.

    The table is as high as the highest nearly level plane anywhere under cloth and paths. It ends 0.1 m beyond them.
    Other colliders are ignored.

    Raises:
        InvalidInput: an unknown arm or frame.
        MissingDependency: the packages for kinematics are not installed.
    """
    names = list(holding_paths(recording))
    if not names or any(name not in recording.robots for name in names):
        return None
    return Scene({name: arm_from_recording(recording, name) for name in names}, table_from_episode(recording))


def joint_motion_for_episode(recording: Recording, scene: Scene | None = None) -> JointPlan | None:
    """Compute joint motions along the paths of the grippers that hold the cloth; None if one of them has no arm.

    Tools turn as the paths say, from an orientation that is chosen anew: cloth is clamped between the fingers.

    Args:
        recording: an episode with ``robots``, whose grippers begin and end at the same times, at rest.
        scene: None: ``scene_from_episode``.

    Raises:
        InvalidInput: the arms cannot do it; names the joint or the pair of solids that prevents it. Or ``scene`` has
            other arms than those that hold the cloth, or as ``scene_from_episode``.
    """
    scene = scene_from_episode(recording) if scene is None else scene
    if scene is None:
        return None
    holding = set(holding_paths(recording))
    if unmatched := holding.symmetric_difference(scene.arms):
        got = f"{sorted(unmatched)}, which have an arm or hold the cloth, but not both"
        raise InvalidInput("scene", got=got, expected=f"an arm for each of {sorted(holding)}")
    paths = replay(recording, names=list(scene.arms))
    motion = {name: _relative_turns(paths[name]) for name in scene.arms}
    end = max(float(path.t[-1]) for path in motion.values())
    return plan(scene, Action(motion, end, end))


def _relative_turns(path: Trajectory) -> Trajectory:
    """The path with rotations relative to the first pose."""
    pose: Tensor = path.pose.clone()
    pose[:, :3, :3] = path.pose[:, :3, :3] @ path.pose[0, :3, :3].mT
    return path._replace(pose=pose)


def table_from_episode(recording: Recording) -> Table | None:
    """Return the table of an episode, as in ``scene_from_episode``; None if no plane is nearly level."""
    if not any(c.normal[2] > MIN_TABLE_NORMAL_Z for c in recording.colliders.values()):
        return None
    paths = replay(recording, names=recording.grasps or None).values()
    points = [torch.cat([path.pose[:, :2, 3] for path in paths]).numpy()]
    if recording.cloth.initial_vertices is not None:
        points.append(recording.cloth.initial_vertices.reshape(-1, 3)[:, :2])
    ground = np.concatenate(points)
    low, high = ground.min(axis=0) - TABLE_MARGIN_M, ground.max(axis=0) + TABLE_MARGIN_M
    corners = np.array([(x, y) for x in (low[0], high[0]) for y in (low[1], high[1])])
    return Table((low[0], high[0]), (low[1], high[1]), max_table_height(recording.colliders, corners))


def max_table_height(colliders: Mapping[str, Collider], places: np.ndarray) -> float:
    """Return the height [m] of the highest nearly level plane at places [N, 2] m; -inf if there is none."""
    planes = [c for c in colliders.values() if c.normal[2] > MIN_TABLE_NORMAL_Z]
    heights = [p.point[2] - (places - p.point[:2]) @ p.normal[:2] / p.normal[2] for p in planes]
    return float(np.max(heights)) if heights else -np.inf
