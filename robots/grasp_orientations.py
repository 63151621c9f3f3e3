"""Candidate grasp orientations.

A parallel gripper can pinch cloth from many directions; the planner tries these. An orientation is fixed at the start.
From then on the tool turns as the path says, because the cloth is clamped between the fingers.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import product
from typing import NamedTuple

import torch
from torch import Tensor

from torchcloth.types import Trajectory

from .arm import Arm

CANDIDATE_TILTS_RAD = (0.6, 0.9, 0.3, 1.2)  # rad
CANDIDATE_ROLLS_RAD = (0.0, 0.5, -0.5, 1.0, -1.0)  # rad
CANDIDATE_ELBOW_OFFSETS_RAD = (0.0, 0.7, -0.7)  # rad


class GraspOrientation(NamedTuple):
    """A direction of the tool, and a posture that the arm stays close to.

    Attributes:
        tilt: rad, from straight down towards the other gripper; for a lone arm, away from its base.
        roll: rad, then about that horizontal direction.
        flipped: half a turn about the tool's axis.
        elbow_offset: rad, offset of the third of seven joints from its home position.
    """

    tilt: float = 0.6
    roll: float = 0.0
    flipped: bool = False
    elbow_offset: float = 0.0

    def tool_rotation(self, heading: Tensor) -> Tensor:
        """Return the tool axes ``[3, 3]`` in the world.

        The axis z points out of the tool; the fingers open along y, across ``heading`` [3].
        """
        up = torch.tensor([0.0, 0.0, 1.0], dtype=heading.dtype)
        z = math.sin(self.tilt) * heading - math.cos(self.tilt) * up
        y = torch.linalg.cross(up, heading) * (-1 if self.flipped else 1)
        upright = torch.stack([torch.linalg.cross(y, z), y, z], dim=-1)
        x, w, _ = heading.tolist()
        cross = torch.tensor([[0.0, 0.0, w], [0.0, 0.0, -x], [-w, x, 0.0]], dtype=heading.dtype)
        turn = torch.eye(3, dtype=heading.dtype) + math.sin(self.roll) * cross
        return (turn + (1 - math.cos(self.roll)) * (cross @ cross)) @ upright

    def reference_posture(self, arm: Arm) -> Tensor:
        """Return the posture ``[J]`` rad that spare degrees of freedom are drawn to."""
        q = arm.home.clone()
        if len(q) > 6:
            q[2] += self.elbow_offset
        return q.clamp(arm.limits.soft_lower, arm.limits.soft_upper)


def list_candidates() -> list[GraspOrientation]:
    """List all orientations that a plan tries."""
    return [GraspOrientation(*choice) for choice in product(CANDIDATE_TILTS_RAD, CANDIDATE_ROLLS_RAD, (False, True))]


def approach_heading(name: str, motion: Mapping[str, Trajectory], arm: Arm) -> Tensor:
    """Return the level unit vector ``[3]`` from this gripper to the middle of all.

    For a lone arm it points away from the arm's base.
    """
    positions = {key: trajectory.pose[0, :3, 3] for key, trajectory in motion.items()}
    offset = torch.stack(list(positions.values())).mean(0) - positions[name]
    if float(offset[:2].norm()) < 1e-6:
        offset = positions[name] - arm.base[:3, 3].to(offset)
    flat = torch.stack([offset[0], offset[1], torch.zeros_like(offset[0])])
    length = flat.norm()
    return flat / length if float(length) > 1e-6 else torch.tensor([1.0, 0.0, 0.0], dtype=offset.dtype)
