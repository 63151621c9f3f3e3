"""What is moved: garments of a child's size and a sheet, what they are made of, and where they are gripped."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from .. import meshes
from ..materials import AEP, AbstractMaterial, OrthotropicAEP
from ..materials.presets import NOMINAL_THICKNESS_M, find_fabric
from ..meshes import Mesh

SHEET = 0.5  # m, its sides
DENSITY = 0.2  # kg/m^2, where the fabric's source gives none
BENDING = 1e-5  # N m, likewise: a light cotton's
DAMPING = 0.03  # s, of bending
OFF = 1.5  # times the true membrane stiffness stands on the data sheet: a fit has something to find
PRESSURE, SLIDING = 60.0, 20.0  # N/m, k h and gamma h between layers: published ones ask for far smaller substeps


class Garment(NamedTuple):
    """A garment whose body lies along y, front up; held at two places, the first by the arm on the side of -x."""

    mesh: Callable[..., Mesh]
    scale: float  # of an adult's measures
    fabric: str
    grips: tuple[str, str]


def _sheet(triangles: int) -> Mesh:
    """A square with its upper corners as places."""
    flat = meshes.rectangle(SHEET, SHEET, triangles=triangles)
    shifted = flat.vertices - [SHEET / 2, SHEET, 0.0]
    far = np.abs(shifted[:, 0]) > SHEET / 2 - 1e-9
    top = far & (shifted[:, 1] > -1e-9)
    places = {"left corner": np.flatnonzero(top & (shifted[:, 0] < 0))}
    places["right corner"] = np.flatnonzero(top & (shifted[:, 0] > 0))
    return Mesh.build(shifted, flat.faces, flat.pattern, places)


GARMENTS = {
    "shirt": Garment(meshes.shirt, 0.7, "shirt", ("left shoulder", "right shoulder")),
    "trousers": Garment(meshes.trousers, 0.5, "pants", ("left waist corner", "right waist corner")),
    "dress": Garment(meshes.dress, 0.5, "dress", ("left shoulder", "right shoulder")),
    "sheet": Garment(_sheet, 1.0, "cotton", ("left corner", "right corner")),
}


def sewn(garment: Garment, triangles: int) -> Mesh:
    """The garment's mesh at its scale, in its own frame."""
    made = garment.mesh(triangles=triangles)
    return Mesh.build(garment.scale * made.vertices, made.faces, garment.scale * np.asarray(made.pattern), made.places)


def material(fabric: str) -> AbstractMaterial:
    """The law of a published fabric, orthotropic where its membrane is, with a softer contact between layers.

    Raises:
        InvalidInput: an unknown fabric, or one whose source leaves out a stiffness.
    """
    row = find_fabric(fabric)
    if row.membrane_warp is not None and row.membrane_warp != row.membrane_weft:
        return OrthotropicAEP(**_softened(row.orthotropic()))
    return AEP(**_softened(row.isotropic()))


def numbers(fabric: str) -> dict[str, float]:
    """Areal density [kg/m^2], bending stiffness [N m] and thickness [m], ours where a fabric's source gives none."""
    row = find_fabric(fabric)
    return {
        "areal_density": row.areal_density or DENSITY,
        "bending_stiffness": row.bending_warp or BENDING,
        "thickness": row.thickness or NOMINAL_THICKNESS_M,
    }


def data_sheet(fabric: str) -> dict[str, float]:
    """Nominal values of an episode's cloth: the membrane ``OFF`` times too stiff (along the warp), the rest true."""
    row = find_fabric(fabric)
    sheet = {"bending_stiffness": numbers(fabric)["bending_stiffness"], "bending_damping_time": DAMPING}
    if row.membrane_warp is not None:
        sheet["membrane_stiffness"] = OFF * row.membrane_warp
    if row.poisson is not None:
        sheet["poisson_ratio"] = row.poisson
    return sheet


def _softened(values: dict[str, Any]) -> dict[str, Any]:
    h = values["thickness"]
    return values | {"contact_stiffness": PRESSURE / h, "shear_stiffness": SLIDING / h}
