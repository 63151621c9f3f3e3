"""Adapter: bias extension of a glass/PP plain weave, 115 x 230 mm at 45 degrees, as a table of force and displacement.

Digitised from Cao et al., Composites Part A 39 (2008) 1037, doi 10.1016/j.compositesa.2008.02.016; 743 g/m^2, 1.2 mm.
Displacement counts from no force. Not known: repeats; yarn moduli (a trellis does not need them); the digitising error.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from torchcloth import Cloth, meshes
from torchcloth.materials import OrthotropicAEP
from torchcloth.recordings import ForceDisplacement

LENGTH, WIDTH, THICKNESS = 0.230, 0.115, 1.2e-3
DENSITY = 0.743  # kg/m^2


def table(path: Path) -> ForceDisplacement:
    """The one specimen."""
    u, force = np.loadtxt(path / "glass_plain_115_230.csv", delimiter=",", skiprows=1).T
    return ForceDisplacement(
        length=LENGTH,
        width=WIDTH,
        angle=np.pi / 4,
        displacement=u * 1e-3,
        force=force,
        extra={
            "source": "Cao et al. 2008, doi 10.1016/j.compositesa.2008.02.016, digitised",
            "not known": "repeats, yarn moduli, contraction",
        },
    )


def start() -> Cloth:
    """Stiff yarns, a shear modulus in the middle of what weaves have."""
    law = OrthotropicAEP(1e6, 1e6, 2e4, 1e-6, thickness=THICKNESS)
    return Cloth(meshes.rectangle(0.1, 0.1, triangles=8), law, DENSITY, contact=None)
