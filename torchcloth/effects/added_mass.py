"""Air that moves along."""

from __future__ import annotations

import math

from torch import Tensor

from .._utils.linalg import dot
from ..errors import InvalidInput
from ..meshes import Mesh
from ..parameters import PhysicalParameter
from ..types import EffectInputs, Surface
from ._triangles import Triangles
from .base import AbstractEffect, Amplitude


class AddedMass(AbstractEffect):
    """Inertia of the air that a sheet pushes aside: t = -rho length n d(n . v)/dt, along the normal only.

    Air as deep as ``length`` goes with each triangle, as much as its rest area has. For a sheet of side L that swings
    as a whole it is about 0.3 to 0.4 L, for a standing wave wavelength / pi. It slows what moves across the sheet,
    leaves every static shape alone, and takes what the sheet seems to lose: the momentum sum m_air n (n . v), where
    normals do not turn, and the energy 1/2 m_air (n . v)^2. Without the part of n . v that turns, light cloth that
    flutters along itself would gain 29 % of energy in a quarter of a second; what the explicit substep leaves is 3 %.
    Where a sheet slides along itself real air stays behind, and edges meet new air; this air slides along.

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
        if not 0 < density < math.inf:
            raise InvalidInput("air density", got=f"{density} kg/m^3", expected="a value > 0")
        self.length = PhysicalParameter(length, "m", "nonnegative", name="depth of the air that moves along")
        self.density = float(density)
        self.triangles = Triangles()

    def bind(self, mesh: Mesh) -> AddedMass:
        """Resolve the triangles."""
        self.triangles.bind(mesh, self.length.raw.device)
        return self

    def coefficients(self) -> Tensor:
        """[..., 1 or E, 1] kg/m^2."""
        return self.density * self.length.field

    def inertia(self, c: Tensor, surface: Surface) -> Tensor:
        """Mass of the air over each triangle's rest area."""
        return c * surface.area

    def force(self, c: Tensor, now: EffectInputs) -> Tensor:
        """-m_air n (v . dn/dt) at the corners, where dn/dt = -(grad v)' n along the sheet; ``inertia`` is n . dv/dt."""
        s = now.surface
        rate1, rate2 = self.triangles.deformation_columns(now.v)
        turning = dot(rate1, s.n) * s.cofactor1 + dot(rate2, s.n) * s.cofactor2  # -J dn/dt
        share = c * s.area / (3 * s.J) * s.n
        return self.triangles.sum_on_vertices([share * dot(v, turning) for v in self.triangles.at_corners(now.v)])

    def extra_repr(self) -> str:
        """One line of the data sheet."""
        return f"density={self.density:g} kg/m^3"
