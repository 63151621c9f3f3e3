"""Joint motions by which the arms that an episode names can do what its grippers do."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from torchcloth.recordings import Recording
from torchcloth.types import Trajectory

from .paths import holding
from .plan import Plan, plan
from .primitives import Action
from .replay import arm_of, replay
from .scene import Scene, Table

AROUND = 0.1  # m, that a table reaches beyond cloth and paths: an episode gives its plane alone
LEVEL = 0.999  # upward part of a table's normal


def retrace(recording: Recording) -> tuple[Scene, Plan] | None:
    """The arms and their motion along the paths of the grippers that hold the cloth; None where one has no arm.

    Tools turn as the paths say, from a hold that is chosen anew: cloth is clamped between the fingers. Arms that hold
    nothing are not looked at, nor colliders that are not level.

    Args:
        recording: an episode with ``robots``; its first shape says how far a table reaches.

    Raises:
        InvalidInput: the arms cannot do it; names the joint or the pair of solids in the way.
        RecordingError: no motion, or an arm that nobody knows.
    """
    names = list(holding(recording))
    if not names or any(name not in recording.robots for name in names):
        return None
    every = replay(recording)
    motion = {name: _turns(every[name]) for name in names}
    scene = Scene({name: arm_of(recording, name) for name in names}, _table(recording, motion))
    end = max(float(path.t[-1]) for path in motion.values())
    return scene, plan(scene, Action(motion, end, end))


def _turns(path: Trajectory) -> Trajectory:
    """With rotations from the first pose on."""
    pose: Tensor = path.pose.clone()
    pose[:, :3, :3] = path.pose[:, :3, :3] @ path.pose[0, :3, :3].mT
    return path._replace(pose=pose)


def _table(recording: Recording, motion: dict[str, Trajectory]) -> Table | None:
    """The highest level plane, below cloth and paths."""
    heights = [float(c.point[2] / c.normal[2]) for c in recording.colliders.values() if c.normal[2] > LEVEL]
    if not heights:
        return None
    places = [torch.cat([path.pose[:, :2, 3] for path in motion.values()]).numpy()]
    if recording.cloth.initial_vertices is not None:
        places.append(recording.cloth.initial_vertices.reshape(-1, 3)[:, :2])
    (x0, y0), (x1, y1) = (f(np.concatenate(places), axis=0) for f in (np.min, np.max))
    return Table((x0 - AROUND, x1 + AROUND), (y0 - AROUND, y1 + AROUND), max(heights))
