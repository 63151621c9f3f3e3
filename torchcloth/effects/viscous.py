"""Membrane viscosity: damping in the plane of the cloth."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from .._utils.linalg import dot
from ..meshes import Mesh
from ..parameters import PhysicalParameter
from ..types import EffectInputs
from ._triangles import Triangles
from .base import AbstractEffect, Amplitude


class KelvinVoigt(AbstractEffect):
    """Viscous membrane: second Piola stress S = viscosity E' with the strain rate E' = sym(F^T F') in material axes.

    Translation and rotation have no strain rate, so they are not damped. Every other motion in the plane loses the
    power viscosity |E'|^2 per rest area. A thread of membrane stiffness Y [N/m] has the relaxation time viscosity / Y.
    Its axial vibration with wave number k decays as exp(-viscosity k^2 t / (2 rho_A)).

    A relaxation time longer than a wave needs for an edge (0.2 ms at 300 N/m, 150 g/m^2 and 1 cm) would cost explicit
    steps in proportion; in stages the cost grows as its square root. The damping rate grows with the square of the
    stretch. The default step is stable for stretches up to 1.3; twice that needs a ``dt`` 16 times shorter.

    Args:
        viscosity: eta [N s/m], >= 0; a scalar, one value per triangle, or [B, 1] for a batch. Threads of 300 N/m that
            relax in 1 to 10 ms have 0.3 to 3.

    Raises:
        InvalidInput: negative viscosity.
    """

    amplitudes = {
        "viscosity": Amplitude(unit="N s/m", typical=1.0, smallest=0.1, confounded_with=("fric.internal_shear",))
    }
    per_triangle = ("viscosity",)

    def __init__(self, viscosity: float | Tensor = 1.0) -> None:
        super().__init__()
        self.viscosity = PhysicalParameter(viscosity, "N s/m", "nonnegative", name="membrane viscosity")
        self.triangles = Triangles()
        self.register_buffer("bound", torch.zeros(0, 1), persistent=False)
        self.bound: Tensor  # [V, 1] -, a vertex's area times the largest damping of a triangle

    def bind(self, mesh: Mesh) -> KelvinVoigt:
        """Resolve the triangles and the bound on their spectrum, and return self."""
        device, dtype = self.viscosity.raw.device, torch.get_default_dtype()
        self.triangles.bind(mesh, device)
        bound = mesh.vertex_area * 3 * largest_strain_rate_eigenvalue(mesh.shape_gradient)
        self.bound = torch.as_tensor(bound, dtype=dtype, device=device).unsqueeze(-1)
        return self

    def coefficients(self) -> Tensor:
        """Return the viscosity, [..., 1 or E, 1] N s/m."""
        return self.viscosity.field

    def force(self, c: Tensor, inputs: EffectInputs) -> Tensor:
        """Return -area F S G_a on the corners of each triangle, summed on the vertices."""
        return strain_rate_force(self.triangles, c, inputs)

    def viscous(self, c: Tensor, inputs: EffectInputs) -> Tensor:
        """Return the whole force, which is linear in velocity."""
        return self.force(c, inputs)

    def stability_bounds(self, c: Tensor, mass: Tensor) -> tuple[Tensor, Tensor]:
        """Bound the damping rate by that of a single triangle with its share of the mass (Irons and Treharne 1971)."""
        return mass.new_zeros(()), self.viscous_stability_bound(c, mass)

    def viscous_stability_bound(self, c: Tensor, mass: Tensor) -> Tensor:
        """Return the damping rate of ``stability_bounds``."""
        return c.amax() * (self.bound / mass).amax()


def strain_rate_force(triangles: Triangles, viscosity: Tensor, inputs: EffectInputs) -> Tensor:
    """Return the force [..., V, 3] N of the stress viscosity E', E' the rate of the Green strain."""
    f1, f2 = inputs.surface.f1, inputs.surface.f2
    rate1, rate2 = triangles.deformation_columns(inputs.v)
    e11, e22, e12 = dot(f1, rate1), dot(f2, rate2), 0.5 * (dot(f1, rate2) + dot(f2, rate1))
    return triangles.stress_force(viscosity * (e11 * f1 + e12 * f2), viscosity * (e12 * f1 + e22 * f2))


def largest_strain_rate_eigenvalue(gradient: np.ndarray) -> float:
    """Return the largest eigenvalue [1/m^2] of |E'|^2 over all triangles, in the velocities of their corners."""
    gx, gy = gradient[..., 0], gradient[..., 1]
    zero = np.zeros_like(gx)
    shear = np.concatenate([gy, gx], -1) / 2**0.5  # |E|^2 = e11^2 + e22^2 + (sqrt 2 e12)^2
    strain = np.stack([np.concatenate([gx, zero], -1), np.concatenate([zero, gy], -1), shear], axis=1)
    return float(np.linalg.eigvalsh(strain @ strain.swapaxes(1, 2)).max())
