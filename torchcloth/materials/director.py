"""Contact and friction across the sheet (Jiang, Gast, Teran 2017), shared by all laws of A-EP.

The paper's QR decomposition is not computed: with the unit normal n, its entries are R33 = d3.n and
|r|^2 = |d3|^2 - R33^2. The stresses below are the exact derivatives with respect to n and d3.
"""

from __future__ import annotations

from abc import ABC
from typing import Any

import torch
from torch import Tensor

from .._utils.linalg import dot, safe_norm
from ..errors import InvalidInput
from ..parameters import PhysicalParameter
from ..types import Surface
from .base import AbstractMaterial
from .yielding import NormYield


class DirectorMaterial(AbstractMaterial, ABC):
    """A sheet with the director law of A-EP; a subclass adds the membrane.

    Director energy: gamma/2 |r|^2 + k/3 (1 - R33)^3 for R33 < 1; friction |gamma r| <= c_F k (1 - R33)^2.

    The subclass's coefficients contain, under the same names, the entries of ``_director_coefficients``.
    """

    contact_parameters = ("contact_stiffness", "shear_stiffness", "cone")

    def __init__(self, thickness: float) -> None:
        super().__init__()
        try:
            self.thickness = float(thickness)
        except (TypeError, ValueError, RuntimeError):
            self.thickness = float("nan")
        if not 0 < self.thickness < float("inf"):
            raise InvalidInput("thickness", got=f"{thickness!r:.40} m", expected="a value > 0")
        self.plastic: NormYield | None = None

    def _add_director_parameters(
        self,
        contact_stiffness: float | Tensor,
        shear_stiffness: float | Tensor,
        cone: float | Tensor,
        plastic: NormYield | None,
    ) -> None:
        """Add the parameters after those of the membrane: reports list them in this order."""
        self.contact_stiffness = PhysicalParameter(contact_stiffness, "Pa", name="contact_stiffness")
        self.shear_stiffness = PhysicalParameter(shear_stiffness, "Pa", name="shear_stiffness")
        self.cone = PhysicalParameter(cone, "-", "nonnegative", name="cone")
        if plastic is not None and not isinstance(plastic, NormYield):
            raise InvalidInput(
                "plastic", got=f"{plastic!r:.40}", expected="a NormYield, or None", remedy="NormYield(0.02)"
            )
        self.plastic = plastic

    def _director_coefficients(self) -> dict[str, Tensor]:
        """Return k h and gamma h [N/m], c_F, and the limit of elastic stretch (infinite without plasticity)."""
        cone = self.cone.field
        return {
            "contact": self.contact_stiffness.field * self.thickness,
            "shear": self.shear_stiffness.field * self.thickness,
            "cone": cone,
            "limit": torch.full_like(cone, float("inf")) if self.plastic is None else self.plastic.limit.field,
        }

    def director_energy(self, c: Any, n: Tensor, d3: Tensor) -> Tensor:
        """Return gamma/2 |r|^2 + k/3 (1 - R33)^3 for R33 < 1."""
        height = dot(n, d3)
        gap = (1 - height).clamp(min=0)
        return 0.5 * c.shear * (dot(d3, d3) - height * height) + c.contact / 3 * gap**3

    def director_stress(self, c: Any, n: Tensor, d3: Tensor) -> tuple[Tensor, Tensor]:
        """Return the derivatives of the energy with respect to n and d3."""
        height = dot(n, d3)
        gap = (1 - height).clamp(min=0)
        slope = c.shear * height + c.contact * gap * gap
        return -slope * d3, c.shear * d3 - slope * n

    def return_map(self, c: Any, n: Tensor, d3: Tensor) -> Tensor:
        """Relax the director to n where layers separate (R33 > 1); otherwise cut its shear to the friction cone."""
        height = dot(n, d3)
        r = d3 - height * n
        length = safe_norm(r)
        gap = (1 - height).clamp(min=0)
        limit = c.cone * c.contact * gap * gap
        friction = c.shear * length
        slips = friction > limit
        keep = torch.where(slips, limit / torch.where(slips, friction, 1.0), 1.0)
        return torch.where(height > 1, n, keep * r + height * n)

    def initial_memory(self, triangles: int) -> Tensor | None:
        """Return the state without plastic set; None without plasticity."""
        return None if self.plastic is None else self.plastic.initial_memory(triangles)

    def flow(self, c: Any, trial: Surface, inverse_plastic: Tensor) -> Tensor:
        """Let the plastic law flow, if there is one."""
        return inverse_plastic if self.plastic is None else self.plastic.flow(c.limit, trial, inverse_plastic)

    def extra_repr(self) -> str:
        """Return the line of the data sheet: thickness."""
        return f"thickness={self.thickness:g} m"
