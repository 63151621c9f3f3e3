"""Air that moves along."""

from __future__ import annotations

from torch import Tensor

from ..errors import InvalidInput
from ..parameters import PhysicalParameter
from ..types import Surface
from .base import AbstractEffect, Amplitude


class AddedMass(AbstractEffect):
    """Inertia of the air that a sheet pushes aside: t = -rho length n (n . dv/dt), along the normal only.

    Air as deep as ``length`` moves with the sheet. For a sheet of side L that swings as a whole it is about 0.3 to 0.4
    L, for a standing wave wavelength / pi. It slows what moves across the sheet, leaves every static shape alone, and
    takes the momentum that the sheet seems to lose: with normals that do not turn, sum (m + m_air n n') v is conserved.
    Where the sheet turns, the air's own change of direction is left out. In its place it would then turn alike, but a
    sheet that moves along itself while it turns lacks -rho length n (v . dn/dt), and the energy of sheet and air is not
    kept: at a depth of 0.1 m a light sheet that flutters freely gains 29 % in a quarter of a second. A swing, which
    moves across itself, hardly notices.

    Args:
        length: depth of the air [m], >= 0; scalar, one value per triangle, or [B, 1] for a batch.
        density: of the air [kg/m^3], a constant.

    Raises:
        InvalidInput: negative length or non-positive density.
    """

    amplitudes = {"length": Amplitude("m", 0.15, 0.015, ("gravity.acceleration", "plane.friction"))}
    per_triangle = ("length",)

    def __init__(self, length: float | Tensor = 0.15, density: float = 1.204) -> None:
        super().__init__()
        if not density > 0:
            raise InvalidInput("air density", got=f"{density} kg/m^3", expected="a value > 0")
        self.length = PhysicalParameter(length, "m", "nonnegative", name="depth of the air that moves along")
        self.density = float(density)

    def coefficients(self) -> Tensor:
        """[..., 1 or E, 1] kg/m^2."""
        return self.density * self.length.field

    def inertia(self, c: Tensor, surface: Surface) -> Tensor:
        """Mass of the air over each triangle's current area."""
        return c * (surface.area * surface.J)

    def extra_repr(self) -> str:
        """One line of the data sheet."""
        return f"density={self.density:g} kg/m^3"
