"""Gravity: the weight of the cloth."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from .._utils.constants import STANDARD_GRAVITY_M_PER_S2
from .._utils.vectors import parse_finite_numbers
from ..types import EffectInputs
from .base import AbstractEffect, Amplitude


class Gravity(AbstractEffect):
    """Uniform gravitational acceleration, f = m R_y R_x g.

    Args:
        acceleration: [3] m/s^2 in world axes, z up. Learnable, after ``acceleration.requires_grad_()``.
        tilt: [2] rad, tilt of the world. The acceleration is turned by the first angle about world x, then by the
            second about world y. Learnable, after ``tilt.requires_grad_()``: a robot base that is not level is a common
            calibration error.

    Raises:
        InvalidInput: not three, or two, finite numbers.
    """

    amplitudes = {
        "acceleration": Amplitude(
            unit="m/s^2", typical=STANDARD_GRAVITY_M_PER_S2, smallest=0.05, confounded_with=("mass.density",)
        ),
        "tilt": Amplitude(
            unit="rad",
            typical=0.01,
            confounded_with=("air.wind", "obs.rotation"),
            signed=True,
            cause="env.gravity_tilt",
            title="Tilt of gravity",
            description="The world's vertical is not where gravity points: robot and camera share a base that leans.",
        ),
    }

    world_facts = ("acceleration", "tilt")

    def __init__(
        self,
        acceleration: Sequence[float] = (0.0, 0.0, -STANDARD_GRAVITY_M_PER_S2),
        tilt: Sequence[float] = (0.0, 0.0),
    ) -> None:
        super().__init__()
        self.acceleration = _vector("gravity acceleration", acceleration, 3, "three finite numbers in m/s^2")
        self.tilt = _vector("gravity tilt", tilt, 2, "two finite angles in rad")

    def coefficients(self) -> Tensor:
        """Return the tilted acceleration, [..., 1, 3] m/s^2."""
        x, y, z = self.acceleration.unbind(-1)
        (cos_x, cos_y), (sin_x, sin_y) = self.tilt.cos().unbind(-1), self.tilt.sin().unbind(-1)
        y, z = cos_x * y - sin_x * z, sin_x * y + cos_x * z
        x, z = cos_y * x + sin_y * z, cos_y * z - sin_y * x
        return torch.stack([x, y, z], dim=-1).unsqueeze(-2)

    def force(self, c: Tensor, inputs: EffectInputs) -> Tensor:
        """Return m g on each vertex."""
        return inputs.mass * c

    def extra_repr(self) -> str:
        """Return the line of the data sheet: acceleration and tilt."""
        acceleration, tilt = ([round(v, 6) for v in p.flatten().tolist()] for p in (self.acceleration, self.tilt))
        return f"acceleration={acceleration} m/s^2" + (f", tilt={tilt} rad" if any(tilt) else "")


def _vector(name: str, values: Sequence[float], size: int, expected: str) -> nn.Parameter:
    return nn.Parameter(parse_finite_numbers(name, values, size, expected).clone(), requires_grad=False)
