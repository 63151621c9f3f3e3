"""Adapter: bias extension of a glass/PP plain weave, 115 x 230 mm at 45 degrees, as a table of force and displacement.

Digitised from Cao et al., Composites Part A 39 (2008) 1037, doi 10.1016/j.compositesa.2008.02.016; 743 g/m^2, 1.2 mm.
Displacement is zero at zero force. Unknown are the repeats, the yarn moduli (which a trellis does not need), and the
digitising error.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from torchcloth import Cloth, meshes
from torchcloth.materials import OrthotropicAEP
from torchcloth.recordings import ForceDisplacement

GLASS_LENGTH_M, GLASS_WIDTH_M, GLASS_THICKNESS_M = 0.230, 0.115, 1.2e-3
GLASS_DENSITY_KG_PER_M2 = 0.743  # kg/m^2


def read_table(path: Path) -> ForceDisplacement:
    """Read the one specimen from the source's folder."""
    u, force = np.loadtxt(path / "glass_plain_115_230.csv", delimiter=",", skiprows=1).T
    return ForceDisplacement(
        length=GLASS_LENGTH_M,
        width=GLASS_WIDTH_M,
        angle=np.pi / 4,
        displacement=u * 1e-3,
        force=force,
        extra={
            "source": "Cao et al. 2008, doi 10.1016/j.compositesa.2008.02.016, digitised",
            "not known": "repeats, yarn moduli, contraction",
        },
    )


def initial_cloth() -> Cloth:
    """Return the cloth to start from: stiff yarns, and a shear modulus in the middle of the range of weaves."""
    law = OrthotropicAEP(1e6, 1e6, 2e4, 1e-6, thickness=GLASS_THICKNESS_M)
    return Cloth(meshes.rectangle(0.1, 0.1, triangles=8), law, GLASS_DENSITY_KG_PER_M2, contact=None)
