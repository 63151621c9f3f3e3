"""Faults of a recording itself. Each function takes a recording and returns the faulty one that is written instead."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from torchcloth.recordings import Recording

CLOCK_JUMP_RANGE_S = (0.1, 0.6)
WRONG_UNIT_FACTORS = (0.25, 4.0)  # depths of 1 mm units read as 0.25 mm units, and the reverse


def make_clock_jump(recording: Recording, rng: np.random.Generator) -> Recording:
    """Let the camera's clock jump ahead half-way."""
    points = recording.require("points")
    is_second_half = np.arange(len(points.t)) >= len(points.t) // 2
    delay = np.where(is_second_half, rng.uniform(*CLOCK_JUMP_RANGE_S), 0.0)
    return replace(recording, points=replace(points, t=points.t + delay))


def swap_grippers(recording: Recording, rng: np.random.Generator) -> Recording:
    """Exchange what the two grippers hold."""
    (first, first_grasp), (second, second_grasp) = recording.grasps.items()
    return replace(recording, grasps={first: second_grasp, second: first_grasp})


def scale_depths(recording: Recording, rng: np.random.Generator) -> Recording:
    """Read depths in a wrong unit."""
    points = recording.require("points")
    eye = recording.cameras["cam0"].T_world_camera[:3, 3]
    return replace(recording, points=replace(points, xyz=eye + rng.choice(WRONG_UNIT_FACTORS) * (points.xyz - eye)))


def mirror_points(recording: Recording, rng: np.random.Generator) -> Recording:
    """Write points in a left-handed world."""
    points = recording.require("points")
    return replace(recording, points=replace(points, xyz=points.xyz * [1.0, -1.0, 1.0]))


FAULTS: dict[str, Callable[[Recording, np.random.Generator], Recording]] = {
    "": lambda recording, rng: recording,
    "clock jump": make_clock_jump,
    "swapped grippers": swap_grippers,
    "wrong unit": scale_depths,
    "mirrored": mirror_points,
}
