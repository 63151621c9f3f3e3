"""Membrane stresses beyond MuJoCo's isotropic membrane, added on the same triangles.

They are second Piola-Kirchhoff stress resultants S [N/m] against the Green strain e; the forces are - area F S grad N.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from .force_terms import ForceTerm, TriangleOperators, advance_dahl_friction

if TYPE_CHECKING:
    from .mujoco_cloth import MujocoCloth

Array = np.ndarray


@dataclass(frozen=True)
class MembraneSpec:
    """Deviations from an isotropic Saint Venant-Kirchhoff membrane with viscosity.

    Attributes:
        weft: -, fraction by which Young's modulus along v is below that along u.
        shear: -, fraction by which the shear modulus differs from the isotropic one.
        stiffening: -, c of T = E e (1 + c e) along u and v, in tension.
        viscosity: s, tau of the added stress tau E de/dt.
        friction: N/m, 2HG, full width of the shear hysteresis loop.
        threshold: rad, shear angle over which the friction builds up.
    """

    weft: float = 0.0
    shear: float = 0.0
    stiffening: float = 0.0
    viscosity: float = 0.0
    friction: float = 0.0
    threshold: float = 0.01


class Membrane(ForceTerm):
    """Forces of the added membrane stresses."""

    def __init__(self, spec: MembraneSpec) -> None:
        self.spec = spec
        self.acts_while_settling = not spec.friction

    def reset(self, cloth: MujocoCloth, x: Array) -> None:
        """Take the cloth's moduli, and start friction without force at positions x [V, 3] m."""
        self.triangles = TriangleOperators(cloth)
        self.young, nu = cloth.spec.membrane_stiffness, cloth.spec.poisson_ratio
        added = orthotropic_stiffness(self.young, nu, 1 - self.spec.weft) - orthotropic_stiffness(self.young, nu, 1)
        self.c11, self.c12, self.c22 = added
        self.shear = self.spec.shear * self.young / (2 * (1 + nu))
        self.angle = 2 * self._strain(*self._columns(x))[2]
        self.dahl_state = np.zeros_like(self.angle)

    def force(self, t: float, x: Array, v: Array) -> Array:
        """Return the forces [V, 3] N of the stresses, and advance the friction."""
        fu, fv = self._columns(x)
        strain = self._strain(fu, fv)
        su, sv, suv = self._elastic_stress(*strain)
        if self.spec.viscosity:
            ru, rv = self._columns(v)
            eta = self.spec.viscosity * self.young
            su, sv = su + eta * _dot(fu, ru), sv + eta * _dot(fv, rv)
            suv = suv + eta * 0.5 * (_dot(fu, rv) + _dot(fv, ru))
        if self.spec.friction:
            angle = 2 * strain[2]
            self.dahl_state = advance_dahl_friction(self.dahl_state, angle - self.angle, self.spec.threshold)
            self.angle = angle
            suv = suv + 0.5 * self.spec.friction * self.dahl_state  # half the loop's width
        su, sv, suv = su[:, None], sv[:, None], suv[:, None]
        return self.triangles.nodal_forces(fu * su + fv * suv, fu * suv + fv * sv)

    def _elastic_stress(self, eu: Array, ev: Array, euv: Array) -> tuple[Array, Array, Array]:
        stiffening = self.spec.stiffening * self.young
        su = self.c11 * eu + self.c12 * ev + stiffening * np.maximum(eu, 0) ** 2
        sv = self.c12 * eu + self.c22 * ev + stiffening * np.maximum(ev, 0) ** 2
        return su, sv, 2 * self.shear * euv

    def _columns(self, field: Array) -> tuple[Array, Array]:
        return self.triangles.derivative_u @ field, self.triangles.derivative_v @ field

    @staticmethod
    def _strain(fu: Array, fv: Array) -> tuple[Array, Array, Array]:
        return 0.5 * (_dot(fu, fu) - 1), 0.5 * (_dot(fv, fv) - 1), 0.5 * _dot(fu, fv)


def orthotropic_stiffness(young: float, nu: float, ratio: float) -> Array:
    """Return the plane-stress stiffnesses C11, C12, C22 [N/m] of an orthotropic membrane.

    Args:
        young: N/m, modulus along u; along v it is ``ratio * young``.
        nu: -, contraction along v under tension along u.
        ratio: -, modulus along v over that along u.
    """
    return young / (1 - ratio * nu**2) * np.array([1.0, ratio * nu, ratio])


def _dot(a: Array, b: Array) -> Array:
    return np.einsum("fc,fc->f", a, b)
