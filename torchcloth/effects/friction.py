"""Internal friction between the yarns, in bending and in shear."""

from __future__ import annotations

import torch
from torch import Tensor

from .._utils.linalg import cross, dot
from ..meshes import Mesh
from ..parameters import PhysicalParameter
from ..types import EffectInputs
from ._bending_stencil import BendingStencil
from ._dahl import check_threshold, update_dahl_fraction
from ._triangles import Triangles
from .base import AbstractEffect, Amplitude, require_memory


class BendingFriction(AbstractEffect):
    """Bending moment z that opposes changes of curvature: z' = (HB / k_t) (k' - |k'| z / HB), Dahl's law.

    Cloth keeps a part of its bend, and its moment has a hysteresis loop. The loss per cycle does not depend on speed:
    4 HB (K - k_t tanh(K / k_t)) per area for curvatures from -K to K. z acts on the curvature along the normal in
    material axes, so it turns with the sheet. k and z are tensors with |k'|^2 = k_ww'^2 + k_ff'^2 + 2 k_wf'^2, so
    friction is the same in all directions.

    Args:
        moment: HB per width [N], >= 0; half the width 2HB of a KES-F loop. Fabrics have 1e-4 to 5e-4.
        threshold: k_t [1/m], > 0, a constant: curvature over which friction builds up.

    Raises:
        InvalidInput: values out of range.
    """

    amplitudes = {
        "moment": Amplitude(
            unit="N",
            typical=2e-4,
            confounded_with=("damp.bend", "plast.crease"),
            cause="fric.internal_bend",
            title="Internal friction in bending",
            description="Yarns rub when the cloth bends, so that it keeps a part of its last shape.",
            diagnosis_typical=3e-4,
        ),
    }
    per_triangle = ()

    def __init__(self, moment: float | Tensor = 2e-4, threshold: float = 5.0) -> None:
        super().__init__()
        self.moment = PhysicalParameter(moment, "N", "nonnegative", name="bending friction moment")
        self.threshold = check_threshold(threshold, "bending friction", "1/m")
        self.stencil = BendingStencil()

    def bind(self, mesh: Mesh) -> BendingFriction:
        """Build the curvature stencils, and return self."""
        self.stencil.bind(mesh, device=self.moment.raw.device)
        return self

    def coefficients(self) -> Tensor:
        """Return HB, [..., 1, 1] N."""
        return self.moment.field

    def initial_memory(self, x: Tensor) -> Tensor:
        """Return the present curvature [1/m] and z / HB = 0, together [..., V, 6]."""
        k = self.stencil.fit_surface(x).curvature
        return torch.cat([k, torch.zeros_like(k)], dim=-1)

    def update_memory(self, c: Tensor, inputs: EffectInputs) -> Tensor:
        """Integrate Dahl's law along the change of curvature."""
        before, fraction = _split_memory(inputs)
        k = self.stencil.fit_surface(inputs.x, inputs.compensation).curvature
        return torch.cat([k, update_dahl_fraction(fraction, k - before, self.threshold)], dim=-1)

    def force(self, c: Tensor, inputs: EffectInputs) -> Tensor:
        """Return the force of the moment z."""
        _, fraction = _split_memory(inputs)
        return self.stencil.moment_force(self.stencil.fit_surface(inputs.x, inputs.compensation), c * fraction)

    def stability_bounds(self, c: Tensor, mass: Tensor) -> tuple[Tensor, Tensor]:
        """Bound omega^2 by twice the sticking stiffness, which a reversal out of sliding meets, and turning of z."""
        per_moment = 2 / self.threshold * self.stencil.bending_bound_over(mass) + self.stencil.turning_bound_over(mass)
        return c.amax() * per_moment, mass.new_zeros(())

    def extra_repr(self) -> str:
        """Return the line of the data sheet: the threshold."""
        return f"threshold={self.threshold:g} 1/m"


class ShearFriction(AbstractEffect):
    """Shear stress z that opposes changes of the angle between warp and weft: z' = (HG / g_t) (g' - |g'| z / HG).

    g is the shear angle: a right angle minus the angle between the yarns. ``BendingFriction`` explains the law.

    Args:
        hysteresis: 2HG [N/m], >= 0, the full width of a KES-F loop. Fabrics have 0.5 to 4.
        threshold: g_t [rad], > 0, a constant: angle over which friction builds up.

    Raises:
        InvalidInput: values out of range.
    """

    amplitudes = {
        "hysteresis": Amplitude(
            unit="N/m",
            typical=1.0,
            confounded_with=("damp.kv",),
            cause="fric.internal_shear",
            title="Internal friction in shear",
            description="Yarns rub when the cloth is sheared.",
        ),
    }
    per_triangle = ("hysteresis",)

    def __init__(self, hysteresis: float | Tensor = 1.0, threshold: float = 0.01) -> None:
        super().__init__()
        self.hysteresis = PhysicalParameter(hysteresis, "N/m", "nonnegative", name="shear friction hysteresis")
        self.threshold = check_threshold(threshold, "shear friction", "rad")
        self.triangles = Triangles()

    def bind(self, mesh: Mesh) -> ShearFriction:
        """Resolve the triangles, and return self."""
        self.triangles.bind(mesh, self.hysteresis.raw.device)
        return self

    @property
    def has_axes(self) -> bool:
        """Whether the effect distinguishes warp and weft: always."""
        return True

    def coefficients(self) -> Tensor:
        """Return HG, [..., 1, 1] N/m."""
        return 0.5 * self.hysteresis.field

    def initial_memory(self, x: Tensor) -> Tensor:
        """Return the present shear angle [rad] and z / HG = 0, together [..., E, 2]."""
        f1, f2 = self.triangles.deformation_columns(x)
        normal = cross(f1, f2)
        angle = _angle(f1, f2, dot(normal, normal).sqrt())
        return torch.cat([angle, torch.zeros_like(angle)], dim=-1)

    def update_memory(self, c: Tensor, inputs: EffectInputs) -> Tensor:
        """Integrate Dahl's law along the change of angle."""
        before, fraction = _split_memory(inputs)
        angle = _angle(inputs.surface.f1, inputs.surface.f2, inputs.surface.J)
        return torch.cat([angle, update_dahl_fraction(fraction, angle - before, self.threshold)], dim=-1)

    def force(self, c: Tensor, inputs: EffectInputs) -> Tensor:
        """Return the force of the stress z, which works on the angle alone."""
        _, fraction = _split_memory(inputs)
        s = inputs.surface
        sine = dot(s.f1, s.f2)
        scale = c * fraction / (sine**2 + s.J**2)
        return self.triangles.stress_force(
            scale * (s.J * s.f2 - sine * s.cofactor1), scale * (s.J * s.f1 - sine * s.cofactor2)
        )

    def stability_bounds(self, c: Tensor, mass: Tensor) -> tuple[Tensor, Tensor]:
        """Bound omega^2 by twice the sticking stiffness, which a reversal out of sliding meets."""
        return 2 / self.threshold * c.amax() * (self.triangles.shear_bound / mass).amax(), mass.new_zeros(())

    def extra_repr(self) -> str:
        """Return the line of the data sheet: the threshold."""
        return f"threshold={self.threshold:g} rad"


def _angle(f1: Tensor, f2: Tensor, area: Tensor) -> Tensor:
    return torch.atan2(dot(f1, f2), area)


def _split_memory(inputs: EffectInputs) -> tuple[Tensor, Tensor]:
    strain, fraction = require_memory(inputs).chunk(2, dim=-1)
    return strain, fraction
