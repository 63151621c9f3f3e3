"""Where the grippers are, and when they stand still."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from torchcloth.recordings import Recording

from .replay import replay

STILL = 2e-3  # m within which a gripper stands
AROUND = 0.2  # s before and after


@dataclass(frozen=True, eq=False)
class Path:
    """One gripper's path on the motion clock."""

    t: np.ndarray  # [K] s
    position: np.ndarray  # [K, 3] m
    rotation: np.ndarray  # [K, 3, 3]

    def at(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Position [..., 3] m and rotation [..., 3, 3] at times [...] s, linear between knots, held beyond the ends."""
        t = np.asarray(t, dtype=float)
        upper = np.clip(np.searchsorted(self.t, t), 1, max(len(self.t) - 1, 1))
        if len(self.t) == 1:
            return np.broadcast_to(self.position[0], (*t.shape, 3)), np.broadcast_to(self.rotation[0], (*t.shape, 3, 3))
        before, after = self.t[upper - 1], self.t[upper]
        share = np.clip((t - before) / (after - before), 0, 1)[..., None]
        position = (1 - share) * self.position[upper - 1] + share * self.position[upper]
        share = share[..., None]
        return position, (1 - share) * self.rotation[upper - 1] + share * self.rotation[upper]

    def still(self, t: np.ndarray) -> np.ndarray:
        """Whether the gripper stands at times [T] s, and shortly before and after."""
        around = self.at(t[:, None] + np.linspace(-AROUND, AROUND, 9))[0]
        return (np.ptp(around, axis=1) < STILL).all(1)


def holding(recording: Recording) -> dict[str, Path]:
    """Those of the grippers that hold the cloth, of all where nothing says so: others stand by. Raises as ``paths``."""
    return paths(recording, recording.grasps or None)


def paths(recording: Recording, names: Collection[str] | None = None) -> dict[str, Path]:
    """The grippers' paths by name, of these or of all; of an arm through its kinematics. Empty without motion.

    Raises:
        MissingDependency: joints were recorded, and the packages for kinematics are not installed.
        RecordingError: joints without their arm.
    """
    if not recording.grippers and not recording.joints:
        return {}
    found = {}
    for name, motion in replay(recording, names=names).items():
        pose = motion.pose.detach().numpy()
        found[name] = Path(motion.t.numpy(), pose[:, :3, 3], pose[:, :3, :3])
    return found
