"""Mass damping: a viscous force in proportion to mass."""

from __future__ import annotations

from torch import Tensor

from ..parameters import PhysicalParameter
from ..types import EffectInputs
from .base import AbstractEffect, Amplitude


class MassDamping(AbstractEffect):
    """Viscous force against absolute velocity, f = -rate m v.

    It is not a property of cloth. It lets a sheet come to rest (``Cloth.settle``), and absorbs whatever else damps.

    Args:
        rate: damping rate [1/s], >= 0.

    Raises:
        InvalidInput: negative rate.
    """

    amplitudes = {
        "rate": Amplitude(
            unit="1/s",
            typical=1.0,
            confounded_with=("air.drag_n",),
            cause="air.linear",
            title="Linear damping",
            description="Something slows the cloth in proportion to its mass and speed.",
            diagnosis_typical=2.0,
        ),
    }
    per_triangle = ()

    def __init__(self, rate: float | Tensor = 1.0) -> None:
        super().__init__()
        self.rate = PhysicalParameter(rate, "1/s", "nonnegative", name="mass damping rate")

    def coefficients(self) -> Tensor:
        """Return the rate, [..., 1, 1] 1/s."""
        return self.rate.field

    def force(self, c: Tensor, inputs: EffectInputs) -> Tensor:
        """Return the force on each vertex."""
        return -(c * inputs.mass) * inputs.v

    def stability_bounds(self, c: Tensor, mass: Tensor) -> tuple[Tensor, Tensor]:
        """Return the rate as the bound on damping."""
        return mass.new_zeros(()), c.amax()
