"""The right stretch of a surface in material axes: closed form, no decomposition, smooth where stretches are equal."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from .._utils.linalg import dot
from ..types import Surface


class Stretch(NamedTuple):
    """U of the polar decomposition F = R U, each [..., E, 1]: the identity at rest, whatever the rotation."""

    warp: Tensor  # U11
    weft: Tensor  # U22
    shear: Tensor  # U12, half the engineering shear
    trace: Tensor  # sigma_1 + sigma_2, positive


def right_stretch(surface: Surface) -> Stretch:
    """U = (F^T F + J 1) / (sigma_1 + sigma_2), with (sigma_1 + sigma_2)^2 = |F|^2 + 2 J (Hoger and Carlson 1984)."""
    warp, weft = dot(surface.f1, surface.f1), dot(surface.f2, surface.f2)
    trace = (warp + weft + 2 * surface.J).sqrt()
    return Stretch((warp + surface.J) / trace, (weft + surface.J) / trace, dot(surface.f1, surface.f2) / trace, trace)
