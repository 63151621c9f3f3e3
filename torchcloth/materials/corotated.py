"""The fixed-corotated membrane: mu sum (sigma_i - 1)^2 and a pressure on the area, without any decomposition."""

from __future__ import annotations

from torch import Tensor

from .._utils.linalg import dot
from ..types import Surface
from .stretch import right_stretch


def energy(mu: Tensor, surface: Surface) -> Tensor:
    """mu |U - 1|^2, U the right stretch: mu (|F|^2 - 2 (sigma_1 + sigma_2) + 2) would have no digits left at rest."""
    u = right_stretch(surface)
    return mu * ((u.warp - 1).square() + (u.weft - 1).square() + 2 * u.shear.square())


def stress(mu: Tensor, pressure: Tensor, surface: Surface) -> tuple[Tensor, Tensor]:
    """P = 2 mu (F - polar rotation) + pressure cof F, where the rotation is (F + cof F) / s."""
    _, s = _invariants(surface)
    bend = 2 * mu / s
    along, across = 2 * mu - bend, pressure - bend
    return (
        along * surface.f1 + across * surface.cofactor1,
        along * surface.f2 + across * surface.cofactor2,
    )


def _invariants(surface: Surface) -> tuple[Tensor, Tensor]:
    """|F|^2 and sigma_1 + sigma_2, each [..., E, 1]."""
    squared = dot(surface.f1, surface.f1) + dot(surface.f2, surface.f2)
    return squared, (squared + 2 * surface.J).sqrt()
