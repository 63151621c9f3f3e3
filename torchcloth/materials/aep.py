"""Anisotropic elasto-plastic cloth (Jiang, Gast, Teran 2017), the law of the DiffCP paper.

The paper's QR decomposition is not computed: with the unit normal n, its entries are R33 = d3.n and
|r|^2 = |d3|^2 - R33^2, and the in-plane energy needs only |F|^2 and the area ratio J. The stresses below are the
exact derivatives of the energy with respect to the two surface columns f1, f2 and the director d3.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import torch
from torch import Tensor

from .._math import dot, safe_norm
from ..errors import InvalidInput
from ..parameters import PhysicalParameter
from ..types import Surface
from .base import AbstractMaterial, Stiffness


class Coefficients(NamedTuple):
    """Stress resultants [N/m] (moduli times thickness) and the cone; each [..., E or 1, 1]."""

    mu: Tensor
    lam: Tensor
    contact: Tensor  # k h
    shear: Tensor  # gamma h, already doubled in the paper's convention
    cone: Tensor  # c_F


class AEP(AbstractMaterial):
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

    Raises:
        InvalidInput: a parameter outside its domain.
    """

    def __init__(
        self,
        youngs_modulus: float | Tensor,
        poisson_ratio: float | Tensor = 0.3,
        contact_stiffness: float | Tensor = 1e6,
        shear_stiffness: float | Tensor = 2.5e5,
        cone: float | Tensor = 0.3,
        thickness: float = 1e-3,
        convention: Literal["plane_stress", "paper"] = "plane_stress",
    ) -> None:
        super().__init__()
        if convention not in ("plane_stress", "paper"):
            raise InvalidInput("convention", got=repr(convention), expected='"plane_stress" or "paper"')
        if not 0 < thickness < float("inf"):
            raise InvalidInput("thickness", got=f"{thickness} m", expected="a value > 0")
        self.youngs_modulus = PhysicalParameter(youngs_modulus, "Pa", name="youngs_modulus")
        self.poisson_ratio = PhysicalParameter(poisson_ratio, "-", "unit_half", name="poisson_ratio")
        self.contact_stiffness = PhysicalParameter(contact_stiffness, "Pa", name="contact_stiffness")
        self.shear_stiffness = PhysicalParameter(shear_stiffness, "Pa", name="shear_stiffness")
        self.cone = PhysicalParameter(cone, "-", "nonnegative", name="cone")
        self.thickness, self.convention = float(thickness), convention

    @classmethod
    def preset(cls, name: str, **changes) -> AEP:
        """A published fabric by name; ``changes`` override single arguments. See ``materials.presets``."""
        from .presets import find

        return cls(**{**find(name).material, **changes})

    @property
    def membrane_stiffness(self) -> Tensor:
        """Y = E h [N/m], the stiffness that data can see."""
        return self.youngs_modulus.value * self.thickness

    def coefficients(self) -> Coefficients:
        """Lame parameters and director stiffnesses times thickness."""
        paper = self.convention == "paper"
        youngs, nu = self.youngs_modulus.field * self.thickness, self.poisson_ratio.field
        lam = youngs * nu / ((1 + nu) * (1 - 2 * nu)) if paper else youngs * nu / (1 - nu * nu)
        return Coefficients(
            mu=youngs / (2 * (1 + nu)),
            lam=lam,
            contact=self.contact_stiffness.field * self.thickness,
            shear=self.shear_stiffness.field * (self.thickness * (2 if paper else 1)),
            cone=self.cone.field,
        )

    def membrane_energy(self, c: Coefficients, surface: Surface) -> Tensor:
        """mu (|F|^2 - 2 s + 2) + lambda/2 (J - 1)^2 with s = sigma_1 + sigma_2 = sqrt(|F|^2 + 2 J)."""
        squared, s = _invariants(surface)
        return c.mu * (squared - 2 * s + 2) + 0.5 * c.lam * (surface.J - 1) ** 2

    def membrane_stress(self, c: Coefficients, surface: Surface) -> tuple[Tensor, Tensor]:
        """P = 2 mu (F - polar rotation) + lambda (J - 1) cof F, where the rotation is (F + cof F) / s."""
        _, s = _invariants(surface)
        bend = 2 * c.mu / s
        along, across = 2 * c.mu - bend, c.lam * (surface.J - 1) - bend
        return (
            along * surface.f1 + across * surface.cofactor1,
            along * surface.f2 + across * surface.cofactor2,
        )

    def director_energy(self, c: Coefficients, n: Tensor, d3: Tensor) -> Tensor:
        """gamma/2 |r|^2 + k/3 (1 - R33)^3 for R33 < 1."""
        height = dot(n, d3)
        gap = (1 - height).clamp(min=0)
        return 0.5 * c.shear * (dot(d3, d3) - height * height) + c.contact / 3 * gap**3

    def director_stress(self, c: Coefficients, n: Tensor, d3: Tensor) -> tuple[Tensor, Tensor]:
        """Derivatives with respect to n and d3."""
        height = dot(n, d3)
        gap = (1 - height).clamp(min=0)
        slope = c.shear * height + c.contact * gap * gap
        return -slope * d3, c.shear * d3 - slope * n

    def return_map(self, c: Coefficients, n: Tensor, d3: Tensor) -> Tensor:
        """Separation (R33 > 1) relaxes the director to n; otherwise the shear is cut to the friction cone."""
        height = dot(n, d3)
        r = d3 - height * n
        length = safe_norm(r)
        gap = (1 - height).clamp(min=0)
        limit = c.cone * c.contact * gap * gap
        friction = c.shear * length
        slips = friction > limit
        keep = torch.where(slips, limit / torch.where(slips, friction, 1.0), 1.0)
        return torch.where(height > 1, n, keep * r + height * n)

    def stiffness(self, c: Coefficients) -> Stiffness:
        """The director's normal tangent 2 k (1 - R33) is taken at half compression."""
        return Stiffness(c.lam, c.mu, c.contact, c.shear)

    def extra_repr(self) -> str:
        """Constants of the data sheet."""
        return f"thickness={self.thickness:g} m, convention={self.convention}"


def _invariants(surface: Surface) -> tuple[Tensor, Tensor]:
    """|F|^2 and sigma_1 + sigma_2, each [..., E, 1]."""
    squared = dot(surface.f1, surface.f1) + dot(surface.f2, surface.f2)
    return squared, (squared + 2 * surface.J).sqrt()
