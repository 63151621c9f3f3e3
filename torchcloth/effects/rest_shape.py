"""Rest shape: a cloth that is not the size of its pattern."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from ..parameters import PhysicalParameter
from .base import AbstractEffect, Amplitude


class Coefficients(NamedTuple):
    """Parameters as fields, each [..., E or 1, 1]: shrinkage [-] and skew [rad]."""

    shrink_warp: Tensor
    shrink_weft: Tensor
    skew: Tensor


_SHRINKAGE = Amplitude(
    unit="-",
    typical=0.02,
    confounded_with=("mass.density", "grip.slip", "elas.ortho"),
    signed=True,
    cause="rest.shrink",
    title="Shrinkage",
    description="The cloth is shorter along warp or weft than its pattern says.",
    diagnosis_typical=0.03,
)


class RestShape(AbstractEffect):
    """The true rest shape after washing or cutting askew: shorter threads than in the pattern, at another angle.

    The warp keeps its direction and 1 - shrink_warp of its length. The weft keeps 1 - shrink_weft of its length and
    leans by ``skew`` towards the warp, in the pattern as it is drawn, whatever the winding of the triangles. The mass
    is that of the pattern; the material law is per area of the true shape. Bending keeps the pattern's lengths, an
    error of second order (shrinkage times bending).

    A law with yarns pulls along right angles of the true shape, so a leaning weft is too soft along itself. With a
    shear modulus of a hundredth of the yarns' modulus the error is 4 % at 0.02 rad and 20 % at 0.05 rad (E / E' = cos^4
    + sin^4 + (E / G - 2 nu) sin^2 cos^2).

    Args:
        shrink_warp: shrinkage of the warp s1 [-], < 1; negative where the cloth has grown. Like the others a scalar,
            one value per triangle, or [B, 1].
        shrink_weft: shrinkage of the weft s2 [-], < 1.
        skew: angle by which the weft leans [rad], within a right angle.

    Raises:
        InvalidInput: values out of range.
    """

    amplitudes = {
        "shrink_warp": _SHRINKAGE,
        "shrink_weft": _SHRINKAGE,
        "skew": Amplitude(
            unit="rad",
            typical=0.02,
            confounded_with=("elas.ortho",),
            signed=True,
            cause="rest.skew",
            title="Skew at rest",
            description="Warp and weft of the cloth at rest are not at right angles.",
            diagnosis_typical=0.03,
        ),
    }
    per_triangle = ("shrink_warp", "shrink_weft", "skew")

    def __init__(
        self, shrink_warp: float | Tensor = 0.0, shrink_weft: float | Tensor = 0.0, skew: float | Tensor = 0.0
    ) -> None:
        super().__init__()
        shorter, turned = (-math.inf, 1.0), (-math.pi / 2, math.pi / 2)
        self.shrink_warp = PhysicalParameter(shrink_warp, "-", "real", name="shrinkage along the warp", bounds=shorter)
        self.shrink_weft = PhysicalParameter(shrink_weft, "-", "real", name="shrinkage along the weft", bounds=shorter)
        self.skew = PhysicalParameter(skew, "rad", "real", name="skew", bounds=turned)

    @property
    def has_axes(self) -> bool:
        """Whether the effect distinguishes warp and weft: always."""
        return True

    def coefficients(self) -> Coefficients:
        """Return the parameters as fields."""
        return Coefficients(self.shrink_warp.field, self.shrink_weft.field, self.skew.field)

    def rest_deformation(self, c: Coefficients) -> Tensor:
        """Return the rest deformation, whose columns are the true warp and weft."""
        warp, weft = 1 - c.shrink_warp, 1 - c.shrink_weft
        rows = torch.broadcast_tensors(warp, weft * c.skew.sin(), torch.zeros_like(warp), weft * c.skew.cos())
        return torch.cat(rows, dim=-1).unflatten(-1, (2, 2))
