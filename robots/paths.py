"""Paths of the grippers, and the times at which they stand still."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from torchcloth.recordings import Recording

from .replay import replay

MAX_STANDING_MOTION_M = 2e-3  # a gripper that moves less stands still
STANDING_WINDOW_S = 0.2  # time before and after, in which it must stand still


@dataclass(frozen=True, eq=False)
class GripperPath:
    """One gripper's path on the motion clock.

    Attributes:
        t: [K] s.
        position: [K, 3] m.
        rotation: [K, 3, 3].
    """

    t: np.ndarray
    position: np.ndarray
    rotation: np.ndarray

    def at(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Interpolate position [..., 3] m and rotation [..., 3, 3] linearly at times [...] s.

        Beyond the ends the pose is that at the end.
        """
        t = np.asarray(t, dtype=float)
        upper = np.clip(np.searchsorted(self.t, t), 1, max(len(self.t) - 1, 1))
        if len(self.t) == 1:
            return np.broadcast_to(self.position[0], (*t.shape, 3)), np.broadcast_to(self.rotation[0], (*t.shape, 3, 3))
        before, after = self.t[upper - 1], self.t[upper]
        fraction = np.clip((t - before) / (after - before), 0, 1)[..., None]
        position = (1 - fraction) * self.position[upper - 1] + fraction * self.position[upper]
        fraction = fraction[..., None]
        return position, (1 - fraction) * self.rotation[upper - 1] + fraction * self.rotation[upper]

    def is_standing(self, t: np.ndarray) -> np.ndarray:
        """Return whether the gripper stands still around each of the times [T] s."""
        around = self.at(t[:, None] + np.linspace(-STANDING_WINDOW_S, STANDING_WINDOW_S, 9))[0]
        return (np.ptp(around, axis=1) < MAX_STANDING_MOTION_M).all(1)


def holding_paths(recording: Recording) -> dict[str, GripperPath]:
    """Return the paths of the grippers that hold the cloth, or of all if the episode names no grasps.

    Raises:
        MissingDependency, RecordingError: as ``gripper_paths``.
    """
    return gripper_paths(recording, recording.grasps or None)


def gripper_paths(recording: Recording, names: Collection[str] | None = None) -> dict[str, GripperPath]:
    """Return the paths by gripper, of the given names or of all; paths of arms follow from their kinematics.

    The result is empty if no motion was recorded.

    Raises:
        MissingDependency: joints were recorded, and the packages for kinematics are not installed.
        RecordingError: joints without their arm.
    """
    if not recording.grippers and not recording.joints:
        return {}
    paths = {}
    for name, motion in replay(recording, names=names).items():
        pose = motion.pose.detach().numpy()
        paths[name] = GripperPath(motion.t.numpy(), pose[:, :3, 3], pose[:, :3, :3])
    return paths
