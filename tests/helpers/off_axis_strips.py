"""Readings of off-axis strips from closed forms, and a cloth with other parameters."""

from __future__ import annotations

from math import cos, radians, sin

import numpy as np

import torchcloth as tc
from torchcloth.recordings import ForceDisplacement

WARP_MODULUS_PA, WEFT_MODULUS_PA, SHEAR_MODULUS_PA, THICKNESS_M = 15e6, 59e6, 3e6, 1e-3


def make_start_cloth(**changes) -> tc.Cloth:
    """Return a cloth whose parameters are far from the truth."""
    law = {
        "youngs_modulus": 4e7,
        "weft_modulus": 2e7,
        "shear_modulus": 1e7,
        "poisson_ratio": 0.01,
        "thickness": THICKNESS_M,
    }
    mesh = tc.meshes.rectangle(0.1, 0.1, triangles=8)
    return tc.Cloth(mesh, tc.materials.OrthotropicAEP(**{**law, **changes}), 0.1, contact=None)


def make_readings(degrees: float, noise: float, rng: np.random.Generator, count: int = 40) -> ForceDisplacement:
    """Return readings at strains up to 0.1 %, with white noise as a fraction of the largest force."""
    strain = np.linspace(0, 1e-3, count)
    force = off_axis_modulus(degrees) * THICKNESS_M * 0.02 * strain
    force = force + noise * force.max() * rng.normal(size=count)
    return ForceDisplacement(length=0.1, width=0.02, angle=radians(degrees), displacement=0.1 * strain, force=force)


def off_axis_modulus(degrees: float) -> float:
    """Return the off-axis modulus [Pa] of Jones."""
    c, s = cos(radians(degrees)), sin(radians(degrees))
    return 1 / (
        c**4 / WARP_MODULUS_PA
        + (1 / SHEAR_MODULUS_PA - 0.02 * (WARP_MODULUS_PA * WEFT_MODULUS_PA) ** -0.5) * s**2 * c**2
        + s**4 / WEFT_MODULUS_PA
    )


MODULUS_NAMES = ["youngs_modulus", "weft_modulus", "shear_modulus"]
TRUE_MODULI_PA = dict(zip(MODULUS_NAMES, (WARP_MODULUS_PA, WEFT_MODULUS_PA, SHEAR_MODULUS_PA), strict=True))
