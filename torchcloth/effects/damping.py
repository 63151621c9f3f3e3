"""Damping in proportion to mass."""

from __future__ import annotations

from torch import Tensor

from ..parameters import PhysicalParameter
from ..types import EffectInputs
from .base import AbstractEffect, Amplitude


class MassDamping(AbstractEffect):
    """Viscous force against absolute velocity, f = -rate m v.

    Not a property of cloth; useful to let a sheet come to rest (``Cloth.settle``) and as a catch-all to be suspected.

    Args:
        rate: [1/s], >= 0.

    Raises:
        InvalidInput: negative rate.
    """

    amplitudes = {"rate": Amplitude("1/s", 1.0, 0.05, ("air",))}
    per_triangle = ()

    def __init__(self, rate: float | Tensor = 1.0) -> None:
        super().__init__()
        self.rate = PhysicalParameter(rate, "1/s", "nonnegative", name="mass damping rate")

    def coefficients(self) -> Tensor:
        """[..., 1, 1] 1/s."""
        return self.rate.field

    def force(self, c: Tensor, now: EffectInputs) -> Tensor:
        """Force on each vertex."""
        return -(c * now.mass) * now.v

    def stability_bounds(self, c: Tensor, mass: Tensor) -> tuple[Tensor, Tensor]:
        """The rate itself."""
        return mass.new_zeros(()), c.amax()
