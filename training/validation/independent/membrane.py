"""What real fabric's membrane has beyond MuJoCo's isotropic one: stresses added to it, on the same triangles.

Second Piola-Kirchhoff stress resultants S [N/m] against the Green strain e, forces - area F S grad N.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from .force_terms import Hook, Triangles, dahl

if TYPE_CHECKING:
    from .mujoco_cloth import MujocoCloth

Array = np.ndarray


@dataclass(frozen=True)
class MembraneSpec:
    """Deviations from an isotropic Saint Venant-Kirchhoff membrane with viscosity.

    Attributes:
        weft: -, by which Young's modulus along v falls short of that along u, as a share.
        shear: -, by which the shear modulus differs from the isotropic one, as a share.
        stiffening: -, c of T = E e (1 + c e) along u and v, in tension.
        viscosity: s, tau of the further stress tau E de/dt.
        friction: N/m, 2HG: full width of the shear loop, built up over ``threshold`` rad.
    """

    weft: float = 0.0
    shear: float = 0.0
    stiffening: float = 0.0
    viscosity: float = 0.0
    friction: float = 0.0
    threshold: float = 0.01


class Membrane(Hook):
    """The added stresses."""

    def __init__(self, spec: MembraneSpec) -> None:
        self.spec = spec
        self.settles = not spec.friction

    def start(self, cloth: MujocoCloth, x: Array) -> None:
        self.triangles = Triangles(cloth)
        self.young, nu = cloth.spec.membrane_stiffness, cloth.spec.poisson_ratio
        self.c11, self.c12, self.c22 = orthotropic(self.young, nu, 1 - self.spec.weft) - orthotropic(self.young, nu, 1)
        self.shear = self.spec.shear * self.young / (2 * (1 + nu))
        self.angle = 2 * self._strain(*self._columns(x))[2]
        self.share = np.zeros_like(self.angle)

    def force(self, t: float, x: Array, v: Array) -> Array:
        fu, fv = self._columns(x)
        strain = self._strain(fu, fv)
        su, sv, suv = self._elastic(*strain)
        if self.spec.viscosity:
            ru, rv = self._columns(v)
            eta = self.spec.viscosity * self.young
            su, sv = su + eta * _dot(fu, ru), sv + eta * _dot(fv, rv)
            suv = suv + eta * 0.5 * (_dot(fu, rv) + _dot(fv, ru))
        if self.spec.friction:
            angle = 2 * strain[2]
            self.share = dahl(self.share, angle - self.angle, self.spec.threshold)
            self.angle = angle
            suv = suv + 0.5 * self.spec.friction * self.share  # half the loop's width
        su, sv, suv = su[:, None], sv[:, None], suv[:, None]
        return self.triangles.divergence(fu * su + fv * suv, fu * suv + fv * sv)

    def _elastic(self, eu: Array, ev: Array, euv: Array) -> tuple[Array, Array, Array]:
        stiff = self.spec.stiffening * self.young
        su = self.c11 * eu + self.c12 * ev + stiff * np.maximum(eu, 0) ** 2
        sv = self.c12 * eu + self.c22 * ev + stiff * np.maximum(ev, 0) ** 2
        return su, sv, 2 * self.shear * euv

    def _columns(self, field: Array) -> tuple[Array, Array]:
        return self.triangles.along_u @ field, self.triangles.along_v @ field

    @staticmethod
    def _strain(fu: Array, fv: Array) -> tuple[Array, Array, Array]:
        return 0.5 * (_dot(fu, fu) - 1), 0.5 * (_dot(fv, fv) - 1), 0.5 * _dot(fu, fv)


def orthotropic(young: float, nu: float, ratio: float) -> Array:
    """Plane-stress stiffnesses C11, C12, C22 [N/m] of moduli ``young`` along u and ``ratio * young`` along v; ``nu`` is
    the contraction along v under tension along u.
    """
    return young / (1 - ratio * nu**2) * np.array([1.0, ratio * nu, ratio])


def _dot(a: Array, b: Array) -> Array:
    return np.einsum("fc,fc->f", a, b)
