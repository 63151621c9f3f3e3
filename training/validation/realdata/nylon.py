"""Adapter: tension of one nylon fabric at 0, 30, 45 and 90 degrees to the warp (github
bertoldi-collab/aerodynamic-textile-metamaterials, MIT), as tables of force and displacement.

The load is carried by 12 strips of 2.25 x 97 mm. The force at zero displacement is the machine's preload: the curve
begins there. Not known: areal density, repeats, contraction (the data's authors found -0.004 for Poisson's ratio).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from torchcloth import Cloth, meshes
from torchcloth.materials import OrthotropicAEP
from torchcloth.recordings import ForceDisplacement

ANGLES = (0, 30, 45, 90)
LENGTH, WIDTH, STRIPS = 0.097, 2.25e-3, 12
H = 1e-3  # m, nominal: only products with it are seen
NAMES = ["youngs_modulus", "weft_modulus", "shear_modulus", "warp_stiffening"]


def tables(path: Path) -> dict[int, ForceDisplacement]:
    """By angle in degrees."""
    out = {}
    for angle in ANGLES:
        u, force = np.loadtxt(path / f"angle{angle:02d}deg.csv", delimiter=",", skiprows=1).T
        out[angle] = ForceDisplacement(
            length=LENGTH,
            width=STRIPS * WIDTH,
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


def start() -> Cloth:
    """A woven cloth far from this one."""
    law = OrthotropicAEP(25e6, 47e6, 4e6, 0.01, warp_stiffening=5.0, thickness=H)
    return Cloth(meshes.rectangle(0.1, 0.1, triangles=8), law, 0.1, contact=None)
