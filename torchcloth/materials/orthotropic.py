"""A-EP for woven cloth: warp, weft and shear independent, and yarns that stiffen in tension.

A corotated sheet with the shear modulus G carries yarns along the columns f1 and f2 of F, whose strains are the change
of their length, e1 = |f1| - 1 and e2 = |f2| - 1, so trellis shear turns yarns without stretching them:

    G sum (sigma_i - 1)^2 + k1 e1^2/2 + k2 e2^2/2 + lambda/2 (J - 1 + (a - 1) e1 + (1/a - 1) e2)^2
    k1 = E_warp/(1 + nu) - 2 G,  k2 = E_weft/(1 + nu) - 2 G
    lambda = nu sqrt(E_warp E_weft) / (1 - nu^2),  a = (E_warp / E_weft)^(1/4)

At small strain this is the orthotropic plane-stress law, and for E_warp = E_weft = 2 (1 + nu) G the isotropic law of
``AEP``. It is positive at any strain for all moduli and nu, also where k1 or k2 is negative, because
(|f1| - 1)^2 <= e11^2 + e12^2 with e = U - 1.
"""

from __future__ import annotations

from abc import ABC
from typing import NamedTuple

from torch import Tensor

from .._utils.linalg import safe_norm
from ..errors import InvalidInput
from ..parameters import PhysicalParameter
from ..types import Surface
from . import corotated, stiffening
from .base import Stiffness
from .director import DirectorMaterial
from .yielding import NormYield


class Coefficients(NamedTuple):
    """Stress resultants (moduli times thickness), friction and the plastic limit, each [..., E or 1, 1].

    Attributes:
        mu: G h [N/m].
        lam: lambda h [N/m].
        balance: a [-], 1 for equal moduli.
        warp: k1 h [N/m], beyond what the sheet carries.
        weft: k2 h [N/m].
        warp_toe: E_warp h times its stiffening [N/m].
        weft_toe: E_weft h times its stiffening [N/m].
        contact: k h [N/m].
        shear: gamma h [N/m].
        cone: c_F [-].
        limit: of the elastic stretch [-], infinite without plasticity.
    """

    mu: Tensor
    lam: Tensor
    balance: Tensor
    warp: Tensor
    weft: Tensor
    warp_toe: Tensor
    weft_toe: Tensor
    contact: Tensor
    shear: Tensor
    cone: Tensor
    limit: Tensor


class WovenMaterial(DirectorMaterial, ABC):
    """The law of this module; a subclass computes the coefficients.

    Attributes:
        stiffening_reach: strain [-] up to which tension stiffens.
    """

    def __init__(self, thickness: float, stiffening_reach: float) -> None:
        super().__init__(thickness)
        if not 0 < stiffening_reach < float("inf"):
            raise InvalidInput("stiffening_reach", got=stiffening_reach, expected="a strain > 0")
        self.stiffening_reach = float(stiffening_reach)

    @property
    def has_axes(self) -> bool:
        """Whether the law distinguishes warp and weft: always, because yarns have directions."""
        return True

    def _woven_coefficients(
        self, warp: Tensor, weft: Tensor, mu: Tensor, nu: Tensor, c1: Tensor, c2: Tensor
    ) -> Coefficients:
        """Return the coefficients for moduli times thickness [N/m] and the stiffening of warp and weft [-]."""
        return Coefficients(
            mu=mu,
            lam=nu * (warp * weft).sqrt() / (1 - nu * nu),
            balance=(warp / weft) ** 0.25,
            warp=warp / (1 + nu) - 2 * mu,
            weft=weft / (1 + nu) - 2 * mu,
            warp_toe=warp * c1,
            weft_toe=weft * c2,
            **self._director_coefficients(),
        )

    def membrane_energy(self, c: Coefficients, surface: Surface) -> Tensor:
        """Return the energy density of the module's docstring, with what stiffening adds."""
        warp, weft = safe_norm(surface.f1) - 1, safe_norm(surface.f2) - 1
        squares = c.warp * warp * warp + c.weft * weft * weft + c.lam * _dilation(c, surface, warp, weft) ** 2
        stiffer = stiffening.energy(c.warp_toe, warp, self.stiffening_reach)
        stiffer = stiffer + stiffening.energy(c.weft_toe, weft, self.stiffening_reach)
        return corotated.energy(c.mu, surface) + 0.5 * squares + stiffer

    def membrane_stress(self, c: Coefficients, surface: Surface) -> tuple[Tensor, Tensor]:
        """Return the exact derivative of the energy: that of the sheet, and tensions along the yarns."""
        length1, length2 = safe_norm(surface.f1), safe_norm(surface.f2)
        warp, weft = length1 - 1, length2 - 1
        pressure = c.lam * _dilation(c, surface, warp, weft)
        tension1 = c.warp * warp + (c.balance - 1) * pressure
        tension2 = c.weft * weft + (1 / c.balance - 1) * pressure
        tension1 = tension1 + stiffening.stress(c.warp_toe, warp, self.stiffening_reach)
        tension2 = tension2 + stiffening.stress(c.weft_toe, weft, self.stiffening_reach)
        p1, p2 = corotated.stress(c.mu, pressure, surface)
        return p1 + tension1 / length1 * surface.f1, p2 + tension2 / length2 * surface.f2

    def stiffness(self, c: Coefficients) -> Stiffness:
        """Return in-plane tangents at ``stiffening_reach``, and the director's, 2 k (1 - R33), at half compression."""
        warp = c.warp + 2 * c.mu + c.lam * c.balance**2 + stiffening.tangent(c.warp_toe, self.stiffening_reach)
        weft = c.weft + 2 * c.mu + c.lam / c.balance**2 + stiffening.tangent(c.weft_toe, self.stiffening_reach)
        return Stiffness(warp, weft, c.lam, c.mu, c.contact, c.shear)

    def extra_repr(self) -> str:
        """Return the line of the data sheet: thickness and stiffening reach."""
        return f"{super().extra_repr()}, stiffening_reach={self.stiffening_reach:g}"


class OrthotropicAEP(WovenMaterial):
    """Orthotropic membrane in the axes of the mesh's (u, v) = (warp, weft), with the director law of ``AEP``.

    Pulled along the warp, T = E_warp e (1 + c e) at small strain, and the sheet contracts along the weft by
    nu sqrt(E_warp / E_weft) e; likewise along the weft. With that symmetric nu = sqrt(nu_12 nu_21) every value in the
    domains below is a stable material, so no fit can leave them.

    Args:
        youngs_modulus: E_warp [Pa]. Scalar or one value per triangle, like every parameter here.
        weft_modulus: E_weft [Pa].
        shear_modulus: G [Pa], in the plane: trellis shear between warp and weft.
        poisson_ratio: nu = sqrt(nu_12 nu_21), in (0, 0.5).
        contact_stiffness: k [Pa].
        shear_stiffness: gamma [Pa], of the director: sliding of layers, not of yarns.
        cone: c_F, tangent of the internal friction angle.
        warp_stiffening: c [-] >= 0 of the warp in tension; fabrics have 5 to 50. 0: none, bitwise.
        weft_stiffening: c [-] of the weft.
        stiffening_reach: strain up to which tension stiffens, a constant; beyond it the tangent E (1 + 2 c reach)
            stays. It bounds the stable step: by default a c of 50 costs a factor of 2.4.
        thickness: h [m], a constant.
        plastic: lasting set in the plane, e.g. ``NormYield(0.02)``; None: always elastic.

    Raises:
        InvalidInput: a parameter outside its domain.
    """

    def __init__(
        self,
        youngs_modulus: float | Tensor,
        weft_modulus: float | Tensor,
        shear_modulus: float | Tensor,
        poisson_ratio: float | Tensor = 0.3,
        *,
        contact_stiffness: float | Tensor = 1e6,
        shear_stiffness: float | Tensor = 2.5e5,
        cone: float | Tensor = 0.3,
        warp_stiffening: float | Tensor = 0.0,
        weft_stiffening: float | Tensor = 0.0,
        stiffening_reach: float = 0.05,
        thickness: float = 1e-3,
        plastic: NormYield | None = None,
    ) -> None:
        super().__init__(thickness, stiffening_reach)
        self.youngs_modulus = PhysicalParameter(youngs_modulus, "Pa", name="youngs_modulus")
        self.weft_modulus = PhysicalParameter(weft_modulus, "Pa", name="weft_modulus")
        self.shear_modulus = PhysicalParameter(shear_modulus, "Pa", name="shear_modulus")
        self.poisson_ratio = PhysicalParameter(poisson_ratio, "-", "unit_half", name="poisson_ratio")
        self.warp_stiffening = PhysicalParameter(warp_stiffening, "-", "nonnegative", name="warp_stiffening")
        self.weft_stiffening = PhysicalParameter(weft_stiffening, "-", "nonnegative", name="weft_stiffening")
        self._add_director_parameters(contact_stiffness, shear_stiffness, cone, plastic)

    @classmethod
    def preset(cls, name: str, **changes) -> OrthotropicAEP:
        """Build a published fabric by name; ``changes`` override or complete its numbers. See ``presets``.

        Raises:
            InvalidInput: no such fabric, or one without published stiffness in warp, weft or shear.
        """
        from .presets import find_fabric

        return cls(**find_fabric(name).orthotropic(**changes))

    def coefficients(self) -> Coefficients:
        """Return stiffnesses times thickness."""
        warp, weft = self.youngs_modulus.field * self.thickness, self.weft_modulus.field * self.thickness
        mu, nu = self.shear_modulus.field * self.thickness, self.poisson_ratio.field
        return self._woven_coefficients(warp, weft, mu, nu, self.warp_stiffening.field, self.weft_stiffening.field)


class StiffeningAEP(WovenMaterial):
    """``AEP`` whose yarns stiffen in tension: one modulus along warp and weft, T = E e (1 + c e) at small strain.

    Args:
        youngs_modulus: E [Pa]. Scalar or one value per triangle, like every parameter here.
        poisson_ratio: nu, in (0, 0.5).
        stiffening: c [-] >= 0; Saint Venant and Kirchhoff's membrane has 1.5, fabrics have 5 to 50.
        contact_stiffness: as for ``OrthotropicAEP``, like the arguments that follow.

    Raises:
        InvalidInput: a parameter outside its domain.
    """

    def __init__(
        self,
        youngs_modulus: float | Tensor,
        poisson_ratio: float | Tensor = 0.3,
        *,
        stiffening: float | Tensor = 0.0,
        contact_stiffness: float | Tensor = 1e6,
        shear_stiffness: float | Tensor = 2.5e5,
        cone: float | Tensor = 0.3,
        stiffening_reach: float = 0.05,
        thickness: float = 1e-3,
        plastic: NormYield | None = None,
    ) -> None:
        super().__init__(thickness, stiffening_reach)
        self.youngs_modulus = PhysicalParameter(youngs_modulus, "Pa", name="youngs_modulus")
        self.poisson_ratio = PhysicalParameter(poisson_ratio, "-", "unit_half", name="poisson_ratio")
        self.stiffening = PhysicalParameter(stiffening, "-", "nonnegative", name="stiffening")
        self._add_director_parameters(contact_stiffness, shear_stiffness, cone, plastic)

    def coefficients(self) -> Coefficients:
        """Return stiffnesses times thickness."""
        modulus, nu = self.youngs_modulus.field * self.thickness, self.poisson_ratio.field
        c = self.stiffening.field
        return self._woven_coefficients(modulus, modulus, modulus / (2 * (1 + nu)), nu, c, c)


def _dilation(c: Coefficients, surface: Surface, warp: Tensor, weft: Tensor) -> Tensor:
    """Return J - 1 with warp and weft weighted by stiffness, so that it couples them as plane stress does."""
    return surface.J - 1 + (c.balance - 1) * warp + (1 / c.balance - 1) * weft
