"""The motion of the example: two Rizon 4 pull a sheet apart, swing it and turn it, as joint trajectories."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from torchcloth.errors import InvalidInput
from torchcloth.robots import Scene

Array = np.ndarray
SIDE = {"left": 1.0, "right": -1.0}  # sign of y: the left arm stands at +y


@dataclass(frozen=True)
class Swing:
    """What the grippers do; times in s from the start of the recording, lengths in m.

    Attributes:
        duration, period: s, length of the motion and time between its knots.
        still: s, the arms stand still until then.
        centre: x, mid height of the upper edge z.
        apart: distance of the grippers at the start.
        stretch: how much further apart they go.
        swing, swing_rate: amplitude along x in m, Hz.
        twist, twist_rate: amplitude by which one gripper leads the other along x (each half of it), Hz.
        tilt: rad, how far the tool leans from straight down towards the other arm.
    """

    duration: float = 2.2
    period: float = 0.01
    still: float = 0.2
    centre: tuple[float, float] = (0.50, 0.50)
    apart: float = 0.402
    stretch: float = 0.036
    swing: float = 0.085
    swing_rate: float = 0.55
    twist: float = 0.02
    twist_rate: float = 0.5
    tilt: float = 0.6

    def times(self) -> Array:
        """Knots [K] s."""
        return np.arange(round(self.duration / self.period) + 1) * self.period

    def poses(self, t: Array) -> dict[str, Array]:
        """Tool poses [K, 4, 4] m in the world, by arm."""
        start = self.still
        # the slow ramps keep the joints' accelerations near 3 rad/s^2, the value of Flexiv's RDK examples
        x = -self.swing * np.sin(2 * np.pi * self.swing_rate * (t - start)) * ramp(t, start, start + 1.2)
        lead = self.twist * np.sin(2 * np.pi * self.twist_rate * (t - 0.6)) * ramp(t, 0.6, 1.6)
        apart = self.apart + self.stretch * (
            ramp(t, start + 0.1, start + 0.8) - 0.5 * ramp(t, 1.1, 1.6) + 0.5 * ramp(t, 1.6, 2.2)
        )
        poses = {}
        for name, side in SIDE.items():
            pose = np.tile(np.eye(4), (len(t), 1, 1))
            pose[:, :3, :3] = self.tool(side)
            pose[:, 0, 3] = self.centre[0] + x + side * lead
            pose[:, 1, 3] = side * apart / 2
            pose[:, 2, 3] = self.centre[1]
            poses[name] = pose
        return poses

    def tool(self, side: float) -> Array:
        """Rotation [3, 3] of the tool: the fingers close along the cloth's normal (tool y along -x) and point down
        and inwards.
        """
        z = np.array([0.0, -side * np.sin(self.tilt), -np.cos(self.tilt)])
        y = np.array([-1.0, 0.0, 0.0])
        return np.stack([np.cross(y, z), y, z], 1)


def ramp(t: Array, start: float, end: float) -> Array:
    """0 before, 1 after, a quintic between (no jump in velocity or acceleration)."""
    s = np.clip((t - start) / (end - start), 0, 1)
    return s**3 * (10 - 15 * s + 6 * s * s)


def joints(rig: Scene, poses: dict[str, Array]) -> dict[str, Array]:
    """Joint positions [K, 7] rad by arm that reach the tool poses [K, 4, 4]."""
    return {
        name: rig[name].inverse(torch.as_tensor(pose), rig[name].home, tolerance=1e-9).numpy()
        for name, pose in poses.items()
    }


def forward(rig: Scene, q: dict[str, Array]) -> dict[str, Array]:
    """Tool poses [K, 4, 4] m of joint positions [K, 7], by arm."""
    return {name: rig[name](torch.as_tensor(value)).detach().numpy() for name, value in q.items()}


def demands(rig: Scene, t: Array, q: dict[str, Array]) -> dict[str, float]:
    """How hard the motion is: the largest share of the soft range and of the velocity limit used, and acceleration in
    rad/s^2.

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
