"""Air."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from .._math import dot
from ..errors import InvalidInput
from ..parameters import PhysicalParameter
from ..types import Moment
from .base import AbstractEffect, Amplitude


class Coefficients(NamedTuple):
    """Half the air's density times the drag coefficient [kg/m^3], [..., 1 or E, 1]."""

    pressure: Tensor


class AirDrag(AbstractEffect):
    """Quadratic drag against motion along the surface normal in still air: f = -1/2 rho C_n a |v_n| v_n n.

    ``a`` is the triangle's current area and v_n the normal component of its centroid velocity.

    Args:
        normal: drag coefficient C_n >= 0; a flat plate has about 1.2.
        density: of the air [kg/m^3], a constant.

    Raises:
        InvalidInput: negative coefficient or non-positive density.
    """

    amplitudes = {"normal": Amplitude("-", 1.2, 0.05, ("mass_damping",))}
    acts_on = "triangles"

    def __init__(self, normal: float | Tensor = 1.2, density: float = 1.204) -> None:
        super().__init__()
        if not density > 0:
            raise InvalidInput("air density", got=f"{density} kg/m^3", expected="a value > 0")
        self.normal = PhysicalParameter(normal, "-", "nonnegative", name="air drag coefficient")
        self.density = float(density)

    def coefficients(self) -> Coefficients:
        """Dynamic pressure per squared velocity."""
        return Coefficients(0.5 * self.density * self.normal.field)

    def force(self, c: Coefficients, now: Moment) -> Tensor:
        """Drag on each triangle."""
        surface = now.surface
        speed = dot(surface.v, surface.n)
        return -(c.pressure * surface.area * surface.J * speed.abs() * speed) * surface.n

    def extra_repr(self) -> str:
        """One line of the data sheet."""
        return f"density={self.density:g} kg/m^3"
