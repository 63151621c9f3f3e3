"""Weight."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from ..errors import InvalidInput
from ..types import Moment
from .base import AbstractEffect, Amplitude


class Gravity(AbstractEffect):
    """Uniform gravitational acceleration, f = m g.

    Args:
        acceleration: [3] m/s^2 in world axes, z up. Learnable: a tilted world is a common calibration error.

    Raises:
        InvalidInput: not three finite numbers.
    """

    amplitudes = {"acceleration": Amplitude("m/s^2", 9.81, 0.05, ("areal_density",))}

    def __init__(self, acceleration: Sequence[float] = (0.0, 0.0, -9.81)) -> None:
        super().__init__()
        vector = torch.as_tensor(acceleration, dtype=torch.get_default_dtype())
        if vector.shape != (3,) or not torch.isfinite(vector).all():
            raise InvalidInput("gravity acceleration", got=acceleration, expected="three finite numbers in m/s^2")
        self.acceleration = nn.Parameter(vector.clone())

    def coefficients(self) -> Tensor:
        """[..., 1, 3] m/s^2."""
        return self.acceleration.unsqueeze(-2)

    def force(self, c: Tensor, now: Moment) -> Tensor:
        """m g on each vertex."""
        return now.mass * c

    def extra_repr(self) -> str:
        """One line of the data sheet."""
        return f"acceleration={[round(value, 6) for value in self.acceleration.tolist()]} m/s^2"
