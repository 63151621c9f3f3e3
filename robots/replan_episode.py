"""Joint motions by which the arms that an episode names can do what its grippers do."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from torchcloth.errors import InvalidInput
from torchcloth.recordings import Collider, Recording
from torchcloth.types import Trajectory

from .paths import holding
from .plan import Plan, plan
from .primitives import Action
from .replay import arm_of, replay
from .scene import Scene, Table

AROUND = 0.1  # m, that a table reaches beyond cloth and paths: an episode gives its plane alone
LEVEL = 0.97  # upward part of a table's normal


def scene_of(recording: Recording) -> Scene | None:
    """The arms of the grippers that hold the cloth, and the table; None where one of them has no arm.

    The table is as high as the highest plane that is about level anywhere under cloth and paths, and ends 0.1 m beyond
    them. Other colliders are not looked at.

    Raises:
        InvalidInput: an arm or a frame that nobody knows.
        MissingDependency: the packages for kinematics are not installed.
    """
    names = list(holding(recording))
    if not names or any(name not in recording.robots for name in names):
        return None
    return Scene({name: arm_of(recording, name) for name in names}, table_of(recording))


def retrace(recording: Recording, scene: Scene | None = None) -> Plan | None:
    """Joint motions along the paths of the grippers that hold the cloth; None where one of them has no arm.

    Tools turn as the paths say, from a hold that is chosen anew: cloth is clamped between the fingers.

    Args:
        recording: an episode with ``robots``, whose grippers begin at one time and end at one, at rest.
        scene: None: ``scene_of`` the episode.

    Raises:
        InvalidInput: the arms cannot do it; names the joint or the pair of solids in the way. Or ``scene`` has other
            arms than those that hold, or as ``scene_of``.
    """
    scene = scene_of(recording) if scene is None else scene
    if scene is None:
        return None
    held = set(holding(recording))
    if other := held.symmetric_difference(scene.arms):
        got = f"{sorted(other)}, with an arm or held and not both"
        raise InvalidInput("scene", got=got, expected=f"an arm for each of {sorted(held)}")
    every = replay(recording, names=list(scene.arms))
    motion = {name: _turns(every[name]) for name in scene.arms}
    end = max(float(path.t[-1]) for path in motion.values())
    return plan(scene, Action(motion, end, end))


def _turns(path: Trajectory) -> Trajectory:
    """With rotations from the first pose on."""
    pose: Tensor = path.pose.clone()
    pose[:, :3, :3] = path.pose[:, :3, :3] @ path.pose[0, :3, :3].mT
    return path._replace(pose=pose)


def table_of(recording: Recording) -> Table | None:
    """As of ``scene_of``."""
    if not any(c.normal[2] > LEVEL for c in recording.colliders.values()):
        return None
    held = replay(recording, names=recording.grasps or None).values()
    places = [torch.cat([path.pose[:, :2, 3] for path in held]).numpy()]
    if recording.cloth.initial_vertices is not None:
        places.append(recording.cloth.initial_vertices.reshape(-1, 3)[:, :2])
    low, high = (f(np.concatenate(places), axis=0) + way for f, way in ((np.min, -AROUND), (np.max, AROUND)))
    corners = np.array([(x, y) for x in (low[0], high[0]) for y in (low[1], high[1])])
    return Table((low[0], high[0]), (low[1], high[1]), highest(recording.colliders, corners))


def highest(colliders: Mapping[str, Collider], places: np.ndarray) -> float:
    """m, of the highest plane that is about level, at places [N, 2] m; -inf where there is none."""
    planes = [c for c in colliders.values() if c.normal[2] > LEVEL]
    heights = [p.point[2] - (places - p.point[:2]) @ p.normal[:2] / p.normal[2] for p in planes]
    return float(np.max(heights)) if heights else -np.inf
