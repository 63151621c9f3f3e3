"""The fixed-corotated membrane: mu sum (sigma_i - 1)^2 and a pressure on the area, without a decomposition."""

from __future__ import annotations

from torch import Tensor

from .._utils.linalg import dot
from ..types import Surface
from .stretch import right_stretch


def energy(mu: Tensor, surface: Surface) -> Tensor:
    """Return mu |U - 1|^2, U the right stretch; mu (|F|^2 - 2 (sigma_1 + sigma_2) + 2) would cancel at rest."""
    u = right_stretch(surface)
    return mu * ((u.warp - 1).square() + (u.weft - 1).square() + 2 * u.shear.square())


def stress(mu: Tensor, pressure: Tensor, surface: Surface) -> tuple[Tensor, Tensor]:
    """Return the columns of P = 2 mu (F - R) + pressure cof F.

    The polar rotation is R = (F + cof F) / s with s = sigma_1 + sigma_2 = sqrt(|F|^2 + 2 J).
    """
    s = (dot(surface.f1, surface.f1) + dot(surface.f2, surface.f2) + 2 * surface.J).sqrt()
    rotation = 2 * mu / s
    of_f, of_cofactor = 2 * mu - rotation, pressure - rotation
    return (
        of_f * surface.f1 + of_cofactor * surface.cofactor1,
        of_f * surface.f2 + of_cofactor * surface.cofactor2,
    )
