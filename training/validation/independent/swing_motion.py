"""The motion of the example, as joint trajectories: two Rizon 4 pull a sheet apart, swing it and turn it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from torchcloth.errors import InvalidInput
from torchcloth.robots import Scene  # pyright: ignore[reportMissingImports] - mapped from robots/

Array = np.ndarray
ARM_SIDES = {"left": 1.0, "right": -1.0}  # sign of y: the left arm stands at +y


@dataclass(frozen=True)
class Swing:
    """Motion of the grippers, from the start of the recording.

    Attributes:
        duration: s, length of the motion.
        period: s, between its knots.
        standstill: s, the arms stand still until then.
        centre: m, x and z of the middle of the upper edge.
        distance: m, between the grippers at the start.
        stretch: m, by which this distance grows.
        swing: m, amplitude along x.
        swing_rate: Hz.
        twist: m, amplitude by which one gripper leads the other along x.
        twist_rate: Hz.
        tilt: rad, by which the tool leans from straight down towards the other arm.
    """

    duration: float = 2.2
    period: float = 0.01
    standstill: float = 0.2
    centre: tuple[float, float] = (0.50, 0.50)
    distance: float = 0.402
    stretch: float = 0.036
    swing: float = 0.085
    swing_rate: float = 0.55
    twist: float = 0.02
    twist_rate: float = 0.5
    tilt: float = 0.6

    def times(self) -> Array:
        """Return the knots [K] s."""
        return np.arange(round(self.duration / self.period) + 1) * self.period

    def poses(self, t: Array) -> dict[str, Array]:
        """Return the tool poses [K, 4, 4] m in the world at times t [K] s, by arm."""
        start = self.standstill
        # the slow ramps keep the joints' accelerations near 3 rad/s^2, the value of Flexiv's RDK examples
        x = -self.swing * np.sin(2 * np.pi * self.swing_rate * (t - start)) * smooth_ramp(t, start, start + 1.2)
        lead = self.twist * np.sin(2 * np.pi * self.twist_rate * (t - 0.6)) * smooth_ramp(t, 0.6, 1.6)
        distance = self.distance + self.stretch * (
            smooth_ramp(t, start + 0.1, start + 0.8) - 0.5 * smooth_ramp(t, 1.1, 1.6) + 0.5 * smooth_ramp(t, 1.6, 2.2)
        )
        poses = {}
        for name, side in ARM_SIDES.items():
            pose = np.tile(np.eye(4), (len(t), 1, 1))
            pose[:, :3, :3] = self.tool_rotation(side)
            pose[:, 0, 3] = self.centre[0] + x + side * lead
            pose[:, 1, 3] = side * distance / 2
            pose[:, 2, 3] = self.centre[1]
            poses[name] = pose
        return poses

    def tool_rotation(self, side: float) -> Array:
        """Return the rotation [3, 3] of the tool.

        The fingers close along the cloth's normal (tool y along -x) and point down and inwards.
        """
        z = np.array([0.0, -side * np.sin(self.tilt), -np.cos(self.tilt)])
        y = np.array([-1.0, 0.0, 0.0])
        return np.stack([np.cross(y, z), y, z], 1)


def smooth_ramp(t: Array, start: float, end: float) -> Array:
    """Return 0 before ``start``, 1 after ``end``, and a quintic between: velocity and acceleration do not jump."""
    s = np.clip((t - start) / (end - start), 0, 1)
    return s**3 * (10 - 15 * s + 6 * s * s)


def hold_from_above(pose: Array, tool_rotation: Array) -> Array:
    """Return the poses [K, 4, 4] m of a tool that holds the cloth from above, turned against what it holds."""
    out = pose.copy()
    out[:, :3, :3] = pose[:, :3, :3] @ tool_rotation
    return out


def move_origin(pose: Array, place: Array) -> Array:
    """Return poses [K, 4, 4] m with their origin at a place [3] m in the gripper."""
    out = pose.copy()
    out[:, :3, 3] += pose[:, :3, :3] @ place
    return out


def sample_poses(t: Array, pose: Array, times: Array) -> Array:
    """Interpolate poses [K, 4, 4] m at t [K] s by splines, [T, 4, 4] at times [T] s."""
    out = np.tile(np.eye(4), (len(times), 1, 1))
    out[:, :3, 3] = CubicSpline(t, pose[:, :3, 3])(times)
    out[:, :3, :3] = RotationSpline(t, Rotation.from_matrix(pose[:, :3, :3]))(times).as_matrix()
    return out


def solve_joint_positions(rig: Scene, poses: dict[str, Array]) -> dict[str, Array]:
    """Return the joint positions [K, 7] rad that reach the tool poses [K, 4, 4] m, by arm."""
    return {
        name: rig[name].inverse(torch.as_tensor(pose), rig[name].home, tolerance=1e-9).numpy()
        for name, pose in poses.items()
    }


def tool_poses(rig: Scene, q: dict[str, Array]) -> dict[str, Array]:
    """Return the tool poses [K, 4, 4] m of joint positions [K, 7] rad, by arm."""
    return {name: rig[name](torch.as_tensor(value)).detach().numpy() for name, value in q.items()}


def measure_joint_usage(rig: Scene, t: Array, q: dict[str, Array]) -> dict[str, float]:
    """Measure how much of the joints' limits a motion uses.

    Returns:
        Largest fraction of the soft range ("range") and of the velocity limit ("velocity"), and largest "acceleration"
        [rad/s^2].

    Raises:
        InvalidInput: a soft position limit or a velocity limit is exceeded.
    """
    used = {"range": 0.0, "velocity": 0.0, "acceleration": 0.0}
    for name, value in q.items():
        limits = rig[name].limits
        low, high, speed = (x.numpy() for x in (limits.soft_lower, limits.soft_upper, limits.velocity))
        velocity = np.gradient(value, t, axis=0)
        used["range"] = max(used["range"], float(np.abs((2 * value - low - high) / (high - low)).max()))
        used["velocity"] = max(used["velocity"], float((np.abs(velocity) / speed).max()))
        used["acceleration"] = max(used["acceleration"], float(np.abs(np.gradient(velocity, t, axis=0)).max()))
    for what in ("range", "velocity"):
        if used[what] > 1:
            raise InvalidInput(
                f"the motion leaves the arms' {what}", got=f"{used[what]:.2f} of the limit", expected="<= 1"
            )
    return used
