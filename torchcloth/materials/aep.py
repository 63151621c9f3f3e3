"""Anisotropic elasto-plastic cloth (A-EP; Jiang, Gast, Teran 2017), the law of the DiffCP paper.

The membrane is in ``corotated``, the law across the sheet in ``director``.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

from torch import Tensor

from ..errors import InvalidInput
from ..parameters import PhysicalParameter
from ..types import Surface
from . import corotated
from .base import Stiffness
from .director import DirectorMaterial
from .yielding import NormYield


class Coefficients(NamedTuple):
    """Stress resultants (moduli times thickness) and friction, each [..., E or 1, 1].

    Attributes:
        mu: Lame parameter [N/m].
        lam: Lame parameter [N/m].
        contact: k h [N/m].
        shear: gamma h [N/m], already doubled in the paper's convention.
        cone: c_F [-].
        limit: of the elastic stretch [-], infinite without plasticity.
    """

    mu: Tensor
    lam: Tensor
    contact: Tensor
    shear: Tensor
    cone: Tensor
    limit: Tensor


class AEP(DirectorMaterial):
    """Isotropic fixed-corotated membrane, compressive contact and frictional shear of the director.

    Energy density: mu sum (sigma_i - 1)^2 + lambda/2 (J - 1)^2 + gamma/2 |r|^2 + k/3 (1 - R33)^3 for R33 < 1.

    Only the products with the thickness h are observable: the membrane stiffness Y = E h, k h and gamma h [N/m].

    Args:
        youngs_modulus: E [Pa]. Scalar or one value per triangle, like every parameter here.
        poisson_ratio: nu, in (0, 0.5).
        contact_stiffness: k [Pa].
        shear_stiffness: gamma [Pa].
        cone: c_F, tangent of the internal friction angle; limits |shear| <= c_F x pressure of the director.
        thickness: h [m], a constant.
        convention: "plane_stress" (lambda = E nu / (1 - nu^2), gamma/2 |r|^2) or "paper" (the DiffCP paper's
            three-dimensional lambda = E nu / ((1 + nu)(1 - 2 nu)) and gamma |r|^2).
        plastic: lasting set in the plane, e.g. ``NormYield(0.02)``; None: always elastic.

    Raises:
        InvalidInput: a parameter outside its domain.
    """

    def __init__(
        self,
        youngs_modulus: float | Tensor,
        poisson_ratio: float | Tensor = 0.3,
        *,
        contact_stiffness: float | Tensor = 1e6,
        shear_stiffness: float | Tensor = 2.5e5,
        cone: float | Tensor = 0.3,
        thickness: float = 1e-3,
        convention: Literal["plane_stress", "paper"] = "plane_stress",
        plastic: NormYield | None = None,
    ) -> None:
        super().__init__(thickness)
        if convention not in ("plane_stress", "paper"):
            raise InvalidInput("convention", got=repr(convention), expected='"plane_stress" or "paper"')
        self.youngs_modulus = PhysicalParameter(youngs_modulus, "Pa", name="youngs_modulus")
        self.poisson_ratio = PhysicalParameter(poisson_ratio, "-", "unit_half", name="poisson_ratio")
        self._add_director_parameters(contact_stiffness, shear_stiffness, cone, plastic)
        self.convention = convention

    @classmethod
    def preset(cls, name: str, **changes) -> AEP:
        """Build a published isotropic fabric by name; ``changes`` override or complete its numbers. See ``presets``.

        The paper's k = 6520 N/m / h makes contact on a fine grid slow (steps of 1e-5 s at 4 mm). If only contact
        as such matters, ``contact_stiffness=5e4, shear_stiffness=2e4`` is ten times faster.

        Raises:
            InvalidInput: no such fabric, or one whose membrane stiffness was not published or is not isotropic.
        """
        from .presets import find_fabric

        return cls(**find_fabric(name).isotropic(**changes))

    @property
    def membrane_stiffness(self) -> Tensor:
        """Membrane stiffness Y = E h [N/m], which data can identify."""
        return self.youngs_modulus.value * self.thickness

    def coefficients(self) -> Coefficients:
        """Return Lame parameters and director stiffnesses times thickness."""
        paper = self.convention == "paper"
        youngs, nu = self.youngs_modulus.field * self.thickness, self.poisson_ratio.field
        lam = youngs * nu / ((1 + nu) * (1 - 2 * nu)) if paper else youngs * nu / (1 - nu * nu)
        director = self._director_coefficients()
        if paper:
            director["shear"] = 2 * director["shear"]
        return Coefficients(mu=youngs / (2 * (1 + nu)), lam=lam, **director)

    def membrane_energy(self, c: Coefficients, surface: Surface) -> Tensor:
        """Return mu sum (sigma_i - 1)^2 + lambda/2 (J - 1)^2."""
        return corotated.energy(c.mu, surface) + 0.5 * c.lam * (surface.J - 1) ** 2

    def membrane_stress(self, c: Coefficients, surface: Surface) -> tuple[Tensor, Tensor]:
        """Return the exact derivative of the energy."""
        return corotated.stress(c.mu, c.lam * (surface.J - 1), surface)

    def stiffness(self, c: Coefficients) -> Stiffness:
        """Return the tangents at rest; the director's normal one, 2 k (1 - R33), at half compression."""
        return Stiffness.isotropic(c.lam, c.mu, c.contact, c.shear)

    def extra_repr(self) -> str:
        """Return the line of the data sheet: thickness and convention."""
        return f"{super().extra_repr()}, convention={self.convention}"
