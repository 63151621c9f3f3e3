"""How a gripper may hold: directions of the tool among which a plan chooses, for a gripper pinches well from many.

A hold is fixed at the start; from then on the tool turns as the path says: cloth is clamped between the fingers.
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

TILTS = (0.6, 0.9, 0.3, 1.2)  # rad
LEANS = (0.0, 0.5, -0.5, 1.0, -1.0)  # rad
ELBOWS = (0.0, 0.7, -0.7)  # rad


class Hold(NamedTuple):
    """A direction of the tool, and a posture of the arm to stay close to."""

    tilt: float = 0.6  # rad, from straight down towards the other gripper (or, alone, away from the base)
    lean: float = 0.0  # rad, then about that horizontal direction
    turned: bool = False  # half a turn about the tool's axis
    elbow: float = 0.0  # rad, by which the third of seven joints is off its home

    def rotation(self, inward: Tensor) -> Tensor:
        """Tool axes ``[3, 3]`` in the world: z out of the tool, fingers open along y, across ``inward`` [3]."""
        up = torch.tensor([0.0, 0.0, 1.0], dtype=inward.dtype)
        z = math.sin(self.tilt) * inward - math.cos(self.tilt) * up
        y = torch.linalg.cross(up, inward) * (-1 if self.turned else 1)
        upright = torch.stack([torch.linalg.cross(y, z), y, z], dim=-1)
        x, w, _ = inward.tolist()
        cross = torch.tensor([[0.0, 0.0, w], [0.0, 0.0, -x], [-w, x, 0.0]], dtype=inward.dtype)
        turn = torch.eye(3, dtype=inward.dtype) + math.sin(self.lean) * cross
        return (turn + (1 - math.cos(self.lean)) * (cross @ cross)) @ upright

    def reference(self, arm: Arm) -> Tensor:
        """``[J]`` rad, the posture that spare freedom is drawn to."""
        q = arm.home.clone()
        if len(q) > 6:
            q[2] += self.elbow
        return q.clamp(arm.limits.soft_lower, arm.limits.soft_upper)


def candidates() -> list[Hold]:
    """All directions that a plan tries."""
    return [Hold(*choice) for choice in product(TILTS, LEANS, (False, True))]


def inward(name: str, motion: Mapping[str, Trajectory], arm: Arm) -> Tensor:
    """Unit vector ``[3]``, level: from this gripper to the middle of all, or away from the base of a lone arm."""
    place = {key: trajectory.pose[0, :3, 3] for key, trajectory in motion.items()}
    way = torch.stack(list(place.values())).mean(0) - place[name]
    if float(way[:2].norm()) < 1e-6:
        way = place[name] - arm.base[:3, 3].to(way)
    flat = torch.stack([way[0], way[1], torch.zeros_like(way[0])])
    length = flat.norm()
    return flat / length if float(length) > 1e-6 else torch.tensor([1.0, 0.0, 0.0], dtype=way.dtype)
