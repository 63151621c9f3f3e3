"""Yarns that stiffen as their crimp is pulled out: T = E e (1 + c e) in tension, linear beyond a strain.

Compression is unchanged. Beyond the strain ``reach`` the tangent stays E (1 + 2 c reach), so the stiffest state is
known and the stable step is valid at any strain. c = 0 adds exact zeros.
"""

from __future__ import annotations

from torch import Tensor


def energy(modulus: Tensor, strain: Tensor, reach: float) -> Tensor:
    """Return what stiffening adds to E e^2 / 2 [J/m^2]: E c e^3 / 3 up to ``reach``; ``modulus`` is E c [N/m]."""
    curved, straight = _parts(strain, reach)
    return modulus * curved * (curved * curved / 3 + curved * straight + straight * straight)


def stress(modulus: Tensor, strain: Tensor, reach: float) -> Tensor:
    """Return the derivative of ``energy`` with respect to the strain [N/m]."""
    curved, straight = _parts(strain, reach)
    return modulus * curved * (curved + 2 * straight)


def tangent(modulus: Tensor, reach: float) -> Tensor:
    """Return the largest second derivative of ``energy`` [N/m]."""
    return 2 * reach * modulus


def _parts(strain: Tensor, reach: float) -> tuple[Tensor, Tensor]:
    return strain.clamp(0.0, reach), (strain - reach).clamp(min=0.0)
