"""Friction between the yarns, when cloth is bent and when it is sheared."""

from __future__ import annotations

import torch
from torch import Tensor

from .._utils.linalg import cross, dot
from ..meshes import Mesh
from ..parameters import PhysicalParameter
from ..types import EffectInputs
from ._bent import BendingStencil
from ._dahl import check_threshold, update_dahl_fraction
from ._triangles import Triangles
from .base import AbstractEffect, Amplitude, require_memory


class BendingFriction(AbstractEffect):
    """Bending moment z that opposes changes of curvature: z' = (HB / k_t) (k' - |k'| z / HB), Dahl's law.

    Cloth keeps some of the bend it had, loops between loading and unloading, and the loss per cycle does not depend on
    how fast it is: 4 HB (K - k_t tanh(K / k_t)) per area at curvatures from -K to K. z acts on the curvature along the
    normal in material axes, so it turns with the sheet; k and z are tensors, |k'|^2 = k_ww'^2 + k_ff'^2 + 2 k_wf'^2, so
    friction is the same in all directions.

    Args:
        moment: HB per width [N], >= 0; half the width 2HB of a KES-F loop. Fabrics have 1e-4 to 5e-4.
        threshold: k_t [1/m], > 0, a constant: curvature over which friction builds up.

    Raises:
        InvalidInput: values out of range.
    """

    amplitudes = {"moment": Amplitude("N", 2e-4, 2e-5, ("bending_damping", "crease"))}
    per_triangle = ()

    def __init__(self, moment: float | Tensor = 2e-4, threshold: float = 5.0) -> None:
        super().__init__()
        self.moment = PhysicalParameter(moment, "N", "nonnegative", name="bending friction moment")
        self.threshold = check_threshold(threshold, "bending friction", "1/m")
        self.stencil = BendingStencil()

    def bind(self, mesh: Mesh) -> BendingFriction:
        """Build the curvature stencils."""
        self.stencil.bind(mesh, device=self.moment.raw.device)
        return self

    def coefficients(self) -> Tensor:
        """HB [..., 1, 1] N."""
        return self.moment.field

    def initial_memory(self, x: Tensor) -> Tensor:
        """[..., V, 6]: curvature where the sheet is [1/m], and z / HB = 0."""
        k = self.stencil.fit_surface(x).curvature
        return torch.cat([k, torch.zeros_like(k)], dim=-1)

    def update_memory(self, c: Tensor, now: EffectInputs) -> Tensor:
        """Dahl's law along the change of curvature."""
        before, share = _halves(now)
        k = self.stencil.fit_surface(now.x, now.compensation).curvature
        return torch.cat([k, update_dahl_fraction(share, k - before, self.threshold)], dim=-1)

    def force(self, c: Tensor, now: EffectInputs) -> Tensor:
        """That of the moment z."""
        _, share = _halves(now)
        return self.stencil.moment_force(self.stencil.fit_surface(now.x, now.compensation), c * share)

    def stability_bounds(self, c: Tensor, mass: Tensor) -> tuple[Tensor, Tensor]:
        """Twice the sticking stiffness, which is what a reversal out of sliding meets, and z's turning."""
        per_moment = 2 / self.threshold * self.stencil.bending_bound_over(mass) + self.stencil.turning_bound_over(mass)
        return c.amax() * per_moment, mass.new_zeros(())

    def extra_repr(self) -> str:
        """One line of the data sheet."""
        return f"threshold={self.threshold:g} 1/m"


class ShearFriction(AbstractEffect):
    """Shear stress z that opposes changes of the angle between warp and weft: z' = (HG / g_t) (g' - |g'| z / HG).

    g is the shear angle, right angle minus that between the yarns; see ``BendingFriction`` for the law.

    Args:
        hysteresis: 2HG [N/m], >= 0, the full width of a KES-F loop. Fabrics have 0.5 to 4.
        threshold: g_t [rad], > 0, a constant: angle over which friction builds up.

    Raises:
        InvalidInput: values out of range.
    """

    amplitudes = {"hysteresis": Amplitude("N/m", 1.0, 0.1, ("membrane_viscosity",))}
    per_triangle = ("hysteresis",)

    def __init__(self, hysteresis: float | Tensor = 1.0, threshold: float = 0.01) -> None:
        super().__init__()
        self.hysteresis = PhysicalParameter(hysteresis, "N/m", "nonnegative", name="shear friction hysteresis")
        self.threshold = check_threshold(threshold, "shear friction", "rad")
        self.triangles = Triangles()

    def bind(self, mesh: Mesh) -> ShearFriction:
        """Resolve the triangles."""
        self.triangles.bind(mesh, self.hysteresis.raw.device)
        return self

    @property
    def has_axes(self) -> bool:
        """Yarns turn against each other."""
        return True

    def coefficients(self) -> Tensor:
        """HG [..., 1, 1] N/m."""
        return 0.5 * self.hysteresis.field

    def initial_memory(self, x: Tensor) -> Tensor:
        """[..., E, 2]: shear angle where the sheet is [rad], and z / HG = 0."""
        f1, f2 = self.triangles.deformation_columns(x)
        normal = cross(f1, f2)
        angle = _angle(f1, f2, dot(normal, normal).sqrt())
        return torch.cat([angle, torch.zeros_like(angle)], dim=-1)

    def update_memory(self, c: Tensor, now: EffectInputs) -> Tensor:
        """Dahl's law along the change of angle."""
        before, share = _halves(now)
        angle = _angle(now.surface.f1, now.surface.f2, now.surface.J)
        return torch.cat([angle, update_dahl_fraction(share, angle - before, self.threshold)], dim=-1)

    def force(self, c: Tensor, now: EffectInputs) -> Tensor:
        """That of the stress z, which works on the angle alone."""
        _, share = _halves(now)
        s = now.surface
        sine = dot(s.f1, s.f2)
        scale = c * share / (sine**2 + s.J**2)
        return self.triangles.stress_force(
            scale * (s.J * s.f2 - sine * s.cofactor1), scale * (s.J * s.f1 - sine * s.cofactor2)
        )

    def stability_bounds(self, c: Tensor, mass: Tensor) -> tuple[Tensor, Tensor]:
        """Twice the sticking stiffness, which is what a reversal out of sliding meets."""
        return 2 / self.threshold * c.amax() * (self.triangles.shear_bound / mass).amax(), mass.new_zeros(())

    def extra_repr(self) -> str:
        """One line of the data sheet."""
        return f"threshold={self.threshold:g} rad"


def _angle(f1: Tensor, f2: Tensor, area: Tensor) -> Tensor:
    return torch.atan2(dot(f1, f2), area)


def _halves(now: EffectInputs) -> tuple[Tensor, Tensor]:
    before, share = require_memory(now).chunk(2, dim=-1)
    return before, share
