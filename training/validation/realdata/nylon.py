"""Adapter: tension of one nylon fabric at 0, 30, 45 and 90 degrees to the warp, as tables of force and displacement.

The source is github bertoldi-collab/aerodynamic-textile-metamaterials, MIT. 12 strips of 2.25 x 97 mm carry the load.
The force at zero displacement is the machine's preload: the curve begins there. Unknown are the areal density, the
repeats and the contraction (the authors of the data give -0.004 for Poisson's ratio).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from torchcloth import Cloth, meshes
from torchcloth.materials import OrthotropicAEP
from torchcloth.recordings import ForceDisplacement

ANGLES_DEG = (0, 30, 45, 90)
NYLON_LENGTH_M, NYLON_STRIP_WIDTH_M, STRIP_COUNT = 0.097, 2.25e-3, 12
NYLON_NOMINAL_THICKNESS_M = 1e-3  # only products with it are observable
NYLON_PARAMETERS = ["youngs_modulus", "weft_modulus", "shear_modulus", "warp_stiffening"]


def read_tables(path: Path) -> dict[int, ForceDisplacement]:
    """Read the tables by angle [degrees]."""
    out = {}
    for angle in ANGLES_DEG:
        u, force = np.loadtxt(path / f"angle{angle:02d}deg.csv", delimiter=",", skiprows=1).T
        out[angle] = ForceDisplacement(
            length=NYLON_LENGTH_M,
            width=STRIP_COUNT * NYLON_STRIP_WIDTH_M,
            angle=np.radians(angle),
            displacement=u * 1e-3,
            force=force,
            preload=float(force[0]),
            licence="MIT",
            extra={
                "source": "github bertoldi-collab/aerodynamic-textile-metamaterials",
                "not known": "areal density, repeats, contraction",
            },
        )
    return out


def initial_cloth() -> Cloth:
    """Return the cloth to start from: a woven cloth that is far from this one."""
    law = OrthotropicAEP(25e6, 47e6, 4e6, 0.01, warp_stiffening=5.0, thickness=NYLON_NOMINAL_THICKNESS_M)
    return Cloth(meshes.rectangle(0.1, 0.1, triangles=8), law, 0.1, contact=None)
