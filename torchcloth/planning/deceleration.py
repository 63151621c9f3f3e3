"""How a motion that is under way where its recording ends comes to rest after it: each coordinate at even deceleration.

What moves by v per second is at rest after v / a seconds, v^2 / (2 a) farther.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from ..boundaries.motion import interpolate
from ..types import Trajectory

LOOK = 0.03  # s, twice that before the end is looked at: measured joints tremble
SLOW = 0.02  # m/s or rad/s: slower is at rest
TINY = 1e-9  # s


class Halt(NamedTuple):
    """Of C coordinates."""

    end: float  # s, until which the motion is as recorded
    speed: Tensor  # [C] per second, there
    needed: Tensor  # [C] s, to come to rest by the accelerations that are allowed,
    taken: Tensor  # [C] s, and that it has: no more than the wait

    @classmethod
    def of(cls, at: Callable[[Tensor], Tensor], begin: float, end: float, wait: float, hardest: Tensor) -> Halt:
        """Of coordinates [N, C] ``at`` times [N] s between ``begin`` and ``end``; ``hardest`` [C] accelerations."""
        step = min(LOOK, (end - begin) / 2)
        last, before, first = at(torch.tensor([end, end - step, end - 2 * step], dtype=torch.float64))
        speed = (3 * last - 4 * before + first) / (2 * step)  # of the parabola through them
        speed = speed.where(speed.abs() > SLOW, 0.0)
        needed = speed.abs() / hardest
        return cls(end, speed, needed, needed.clamp(max=wait))

    def beyond(self, times: Tensor) -> Tensor:
        """[N, C], how far from where it is at the end it has come at ``times`` [N] s."""
        after = torch.minimum((times[:, None] - self.end).clamp(min=0), self.taken)
        return self.speed * after * (1 - after / (2 * self.taken.clamp(min=TINY)))


def moved(path: Trajectory, end: float) -> Callable[[Tensor], Tensor]:
    """[N, 6] at [N] s: places [m] of a path, turns from its pose at ``end`` [rad, as vectors in world axes]."""
    last = interpolate(path, path.t.new_tensor([end]))[0, :3, :3]

    def at(times: Tensor) -> Tensor:
        pose = interpolate(path, times)
        turn = Rotation.from_matrix((pose[:, :3, :3] @ last.mT).numpy()).as_rotvec()
        return torch.cat([pose[:, :3, 3], torch.as_tensor(turn)], 1)

    return at
