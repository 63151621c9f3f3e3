"""What goes wrong in a recording itself: each takes a recording and returns the one that was written instead."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from torchcloth.recordings import Recording

JUMPS = (0.1, 0.6)  # s
UNITS = (0.25, 4.0)  # depth units of 1 mm read as units of 0.25 mm, and the other way round


def clock_jump(recording: Recording, rng: np.random.Generator) -> Recording:
    """The camera's clock jumps ahead half-way."""
    points = recording.require("points")
    late = np.where(np.arange(len(points.t)) >= len(points.t) // 2, rng.uniform(*JUMPS), 0.0)
    return replace(recording, points=replace(points, t=points.t + late))


def swapped_grippers(recording: Recording, rng: np.random.Generator) -> Recording:
    """Each gripper is said to hold what the other holds."""
    (one, held), (other, also) = recording.grasps.items()
    return replace(recording, grasps={one: also, other: held})


def wrong_unit(recording: Recording, rng: np.random.Generator) -> Recording:
    """Depths in another unit than is said."""
    points = recording.require("points")
    eye = recording.cameras["cam0"].T_world_camera[:3, 3]
    return replace(recording, points=replace(points, xyz=eye + rng.choice(UNITS) * (points.xyz - eye)))


def mirrored(recording: Recording, rng: np.random.Generator) -> Recording:
    """A left-handed world."""
    points = recording.require("points")
    return replace(recording, points=replace(points, xyz=points.xyz * [1.0, -1.0, 1.0]))


FAULTS: dict[str, Callable[[Recording, np.random.Generator], Recording]] = {
    "": lambda recording, rng: recording,
    "clock jump": clock_jump,
    "swapped grippers": swapped_grippers,
    "wrong unit": wrong_unit,
    "mirrored": mirrored,
}
