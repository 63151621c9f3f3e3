"""Deceleration of a motion that has not come to rest where its recording ends.

Each coordinate decelerates evenly: a speed v and a deceleration a take v / a seconds and cover v^2 / (2 a).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from ..boundaries.motion import interpolate_poses
from ..types import Trajectory

VELOCITY_WINDOW_S = 0.03  # step of the finite difference of the final speed; measured joints tremble
MIN_MOVING_SPEED = 0.02  # m/s or rad/s; a slower coordinate counts as at rest
MIN_DECELERATION_TIME_S = 1e-9  # avoids a division by zero


class Deceleration(NamedTuple):
    """How C coordinates come to rest after the end of a recording.

    Attributes:
        end_time: s, until which the motion is as recorded.
        speed: [C] 1/s, speed of each coordinate at ``end_time``.
        required_time: [C] s, time to come to rest at the largest allowed acceleration.
        allotted_time: [C] s, time that each coordinate gets: at most the wait after the motion.
    """

    end_time: float
    speed: Tensor
    required_time: Tensor
    allotted_time: Tensor

    @classmethod
    def estimate(
        cls, coordinates: Callable[[Tensor], Tensor], begin: float, end: float, wait: float, max_acceleration: Tensor
    ) -> Deceleration:
        """Estimate the final speed of a motion and the time that it takes to come to rest.

        The speed is the slope, at the end, of the parabola through the last 60 ms.

        Args:
            coordinates: gives coordinates [N, C] at times [N] s between ``begin`` and ``end``.
            begin: s, start of the motion.
            end: s, end of the motion.
            wait: s, time after the motion.
            max_acceleration: [C] 1/s^2, largest allowed acceleration.
        """
        step = min(VELOCITY_WINDOW_S, (end - begin) / 2)
        last, middle, first = coordinates(torch.tensor([end, end - step, end - 2 * step], dtype=torch.float64))
        speed = (3 * last - 4 * middle + first) / (2 * step)
        speed = speed.where(speed.abs() > MIN_MOVING_SPEED, 0.0)
        required_time = speed.abs() / max_acceleration
        return cls(end, speed, required_time, required_time.clamp(max=wait))

    def displacement(self, times: Tensor) -> Tensor:
        """Return how far each coordinate has moved since ``end_time``: [N, C] at ``times`` [N] s."""
        elapsed = torch.minimum((times[:, None] - self.end_time).clamp(min=0), self.allotted_time)
        return self.speed * elapsed * (1 - elapsed / (2 * self.allotted_time.clamp(min=MIN_DECELERATION_TIME_S)))


def gripper_coordinates(path: Trajectory, end: float) -> Callable[[Tensor], Tensor]:
    """Return a function that gives the six coordinates of a gripper [N, 6] at times [N] s.

    The first three are the position [m]. The others are the rotation from the pose at ``end`` [s], as a rotation vector
    in world axes [rad].
    """
    last = interpolate_poses(path, path.t.new_tensor([end]))[0, :3, :3]

    def coordinates(times: Tensor) -> Tensor:
        pose = interpolate_poses(path, times)
        turn = Rotation.from_matrix((pose[:, :3, :3] @ last.mT).numpy()).as_rotvec()
        return torch.cat([pose[:, :3, 3], torch.as_tensor(turn)], 1)

    return coordinates
