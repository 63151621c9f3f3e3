"""Weight."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from .._utils.vectors import parse_finite_numbers
from ..types import EffectInputs
from .base import AbstractEffect, Amplitude


class Gravity(AbstractEffect):
    """Uniform gravitational acceleration, f = m R_y R_x g.

    Args:
        acceleration: [3] m/s^2 in world axes, z up. Learnable.
        tilt: [2] rad, by which the world is askew: the acceleration is turned by the first angle about world x, then
            by the second about world y. Learnable: a base that is not level is a common calibration error.

    Raises:
        InvalidInput: not three, or two, finite numbers.
    """

    amplitudes = {
        "acceleration": Amplitude("m/s^2", 9.81, 0.05, ("areal_density",)),
        "tilt": Amplitude("rad", 0.01, 0.002, ("air.wind", "camera.rotation")),
    }

    def __init__(self, acceleration: Sequence[float] = (0.0, 0.0, -9.81), tilt: Sequence[float] = (0.0, 0.0)) -> None:
        super().__init__()
        self.acceleration = _vector("gravity acceleration", acceleration, 3, "three finite numbers in m/s^2")
        self.tilt = _vector("gravity tilt", tilt, 2, "two finite angles in rad")

    def coefficients(self) -> Tensor:
        """[..., 1, 3] m/s^2, the tilted acceleration."""
        x, y, z = self.acceleration.unbind(-1)
        (cos_x, cos_y), (sin_x, sin_y) = self.tilt.cos().unbind(-1), self.tilt.sin().unbind(-1)
        y, z = cos_x * y - sin_x * z, sin_x * y + cos_x * z
        x, z = cos_y * x + sin_y * z, cos_y * z - sin_y * x
        return torch.stack([x, y, z], dim=-1).unsqueeze(-2)

    def force(self, c: Tensor, now: EffectInputs) -> Tensor:
        """m g on each vertex."""
        return now.mass * c

    def extra_repr(self) -> str:
        """One line of the data sheet."""
        acceleration, tilt = ([round(v, 6) for v in p.flatten().tolist()] for p in (self.acceleration, self.tilt))
        return f"acceleration={acceleration} m/s^2" + (f", tilt={tilt} rad" if any(tilt) else "")


def _vector(name: str, values: Sequence[float], size: int, expected: str) -> nn.Parameter:
    return nn.Parameter(parse_finite_numbers(name, values, size, expected).clone())
