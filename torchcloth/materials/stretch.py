"""The right stretch tensor of a surface in material axes, in closed form: smooth where both stretches are equal."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from .._utils.linalg import dot
from ..types import Surface


class Stretch(NamedTuple):
    """U of the polar decomposition F = R U: the identity at rest, whatever the rotation.

    Attributes:
        warp: U11 [..., E, 1].
        weft: U22 [..., E, 1].
        shear: U12 [..., E, 1], half the engineering shear.
        trace: sigma_1 + sigma_2 [..., E, 1], positive.
    """

    warp: Tensor
    weft: Tensor
    shear: Tensor
    trace: Tensor


def right_stretch(surface: Surface) -> Stretch:
    """Compute U = (F^T F + J 1) / (sigma_1 + sigma_2), (sigma_1 + sigma_2)^2 = |F|^2 + 2 J (Hoger and Carlson 1984)."""
    warp, weft = dot(surface.f1, surface.f1), dot(surface.f2, surface.f2)
    trace = (warp + weft + 2 * surface.J).sqrt()
    return Stretch((warp + surface.J) / trace, (weft + surface.J) / trace, dot(surface.f1, surface.f2) / trace, trace)
