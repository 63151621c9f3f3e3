"""Damping in the plane of the cloth."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ..meshes import Mesh
from ..parameters import PhysicalParameter
from ..types import Moment
from .base import AbstractEffect, Amplitude


class KelvinVoigt(AbstractEffect):
    """Viscous membrane: second Piola stress S = viscosity E' with the strain rate E' = sym(F^T F') in material axes.

    Neither translation nor rotation strains, so neither is damped; every other motion in the plane loses the power
    viscosity |E'|^2 per rest area. A thread of membrane stiffness Y [N/m] has the relaxation time viscosity / Y, and
    its axial vibration with wave number k decays as exp(-viscosity k^2 t / (2 rho_A)).

    The step is explicit and falls with rho_A edge^2 / viscosity: relaxation times beyond the time that a wave needs
    for an edge (0.2 ms at 300 N/m, 150 g/m^2 and 1 cm) cost steps in proportion.

    Args:
        viscosity: eta [N s/m], >= 0: scalar, one value per triangle, or [B, 1] for a batch. Threads of 300 N/m that
            relax in 1 to 10 ms have 0.3 to 3.

    Raises:
        InvalidInput: negative viscosity.
    """

    amplitudes = {"viscosity": Amplitude("N s/m", 1.0, 0.1, ("numerics", "internal_friction"))}

    def __init__(self, viscosity: float | Tensor = 1.0) -> None:
        super().__init__()
        self.viscosity = PhysicalParameter(viscosity, "N s/m", "nonnegative", name="membrane viscosity")
        for name, like in (("corners", torch.long), ("gradient", None), ("bound", None)):
            self.register_buffer(name, torch.zeros(0, dtype=like), persistent=False)
        self.corners: Tensor  # [3 E], all first corners, then all second, then all third
        self.gradient: Tensor  # [3, 2, E, 1] 1/m, of the corners' shape functions along warp and weft
        self.bound: Tensor  # [V, 1] m^2 / m^2: a vertex's area times the largest damping of a triangle

    def bind(self, mesh: Mesh) -> KelvinVoigt:
        """Gradients of the shape functions, and the bound on their spectrum."""
        device, dtype = self.viscosity.raw.device, torch.get_default_dtype()
        gradient = mesh.shape_gradient
        share = np.bincount(mesh.faces.ravel(), np.repeat(mesh.area / 3, 3))
        self.corners = torch.as_tensor(mesh.faces.T.ravel().copy(), device=device)
        laid = gradient.transpose(1, 2, 0)[..., None].copy()
        self.gradient = torch.as_tensor(laid, dtype=dtype, device=device)
        bound = share * 3 * _largest(gradient)
        self.bound = torch.as_tensor(bound, dtype=dtype, device=device).unsqueeze(-1)
        return self

    def coefficients(self) -> Tensor:
        """[..., 1 or E, 1] N s/m."""
        return self.viscosity.field

    def force(self, c: Tensor, now: Moment) -> Tensor:
        """-area F S G_a on the corners of each triangle, summed on the vertices."""
        f1, f2 = now.surface.f1, now.surface.f2
        rate1, rate2 = self._rates_of_deformation(now.v)
        e11, e22 = (f1 * rate1).sum(-1, keepdim=True), (f2 * rate2).sum(-1, keepdim=True)
        e12 = 0.5 * ((f1 * rate2).sum(-1, keepdim=True) + (f2 * rate1).sum(-1, keepdim=True))
        weight = c * now.surface.area
        p1, p2 = weight * (e11 * f1 + e12 * f2), weight * (e12 * f1 + e22 * f2)
        second, third = (-(g[0] * p1 + g[1] * p2) for g in self.gradient[1:])
        stacked = torch.cat([-(second + third), second, third], dim=-2)
        index = self.corners.unsqueeze(-1).expand(stacked.shape)
        return torch.zeros_like(now.x).expand(*stacked.shape[:-2], -1, -1).scatter_add(-2, index, stacked)

    def _rates_of_deformation(self, v: Tensor) -> tuple[Tensor, Tensor]:
        """Columns of F' [..., E, 3] 1/s; differences first, so that a common velocity cancels exactly."""
        v0, v1, v2 = v.index_select(-2, self.corners).unflatten(-2, (3, -1)).unbind(-3)
        (a1, a2), (b1, b2) = self.gradient[1], self.gradient[2]
        return a1 * (v1 - v0) + b1 * (v2 - v0), a2 * (v1 - v0) + b2 * (v2 - v0)

    def rates(self, c: Tensor, mass: Tensor) -> tuple[Tensor, Tensor]:
        """The largest damping rate of a single triangle on its own share of the vertices' mass (Irons, Treharne)."""
        return mass.new_zeros(()), c.amax() * (self.bound / mass).amax()


def _largest(gradient: np.ndarray) -> float:
    """Largest eigenvalue [1/m^2] of |E'|^2 over the triangles, in the velocities of their corners."""
    gx, gy = gradient[..., 0], gradient[..., 1]
    zero = np.zeros_like(gx)
    shear = np.concatenate([gy, gx], -1) / 2**0.5  # |E|^2 = e11^2 + e22^2 + (sqrt 2 e12)^2
    strain = np.stack([np.concatenate([gx, zero], -1), np.concatenate([zero, gy], -1), shear], axis=1)
    return float(np.linalg.eigvalsh(strain @ strain.swapaxes(1, 2)).max())
