"""Garments of a child's size and a sheet: meshes, materials and grip places."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from .. import meshes
from ..materials import AEP, AbstractMaterial, OrthotropicAEP
from ..materials.presets import NOMINAL_THICKNESS_M, find_fabric
from ..meshes import Mesh

SYNTHETIC_SHEET_SIDE_M = 0.5
DEFAULT_AREAL_DENSITY_KG_PER_M2 = 0.2  # if the fabric's source gives none
DEFAULT_BENDING_STIFFNESS_NM = 1e-5  # likewise; that of a light cotton
BENDING_DAMPING_TIME_S = 0.03
NOMINAL_STIFFNESS_FACTOR = 1.5  # nominal over true membrane stiffness, so that a fit has something to find
GARMENT_CONTACT_STIFFNESS_N_PER_M, SHEAR_STIFFNESS_N_PER_M = (
    60.0,
    20.0,
)  # k h and gamma h; published ones need tiny substeps


class Garment(NamedTuple):
    """A garment. Its body lies along y, front up, and it is gripped at two places.

    Attributes:
        mesh: function that builds the mesh, with argument ``triangles``.
        scale: of an adult's measures.
        fabric: name of the preset.
        grips: places on the mesh; the first one is on the side of -x.
    """

    mesh: Callable[..., Mesh]
    scale: float
    fabric: str
    grips: tuple[str, str]


def _sheet(triangles: int) -> Mesh:
    """Return a square mesh with its upper corners as places."""
    flat = meshes.rectangle(SYNTHETIC_SHEET_SIDE_M, SYNTHETIC_SHEET_SIDE_M, triangles=triangles)
    shifted = flat.vertices - [SYNTHETIC_SHEET_SIDE_M / 2, SYNTHETIC_SHEET_SIDE_M, 0.0]
    at_side = np.abs(shifted[:, 0]) > SYNTHETIC_SHEET_SIDE_M / 2 - 1e-9
    top = at_side & (shifted[:, 1] > -1e-9)
    places = {"left corner": np.flatnonzero(top & (shifted[:, 0] < 0))}
    places["right corner"] = np.flatnonzero(top & (shifted[:, 0] > 0))
    return Mesh.build(shifted, flat.faces, flat.pattern, places)


GARMENTS = {
    "shirt": Garment(meshes.shirt, 0.7, "shirt", ("left shoulder", "right shoulder")),
    "trousers": Garment(meshes.trousers, 0.5, "pants", ("left waist corner", "right waist corner")),
    "dress": Garment(meshes.dress, 0.5, "dress", ("left shoulder", "right shoulder")),
    "sheet": Garment(_sheet, 1.0, "cotton", ("left corner", "right corner")),
}


def build_garment_mesh(garment: Garment, triangles: int) -> Mesh:
    """Build the garment's mesh at its scale, in the garment's frame."""
    mesh = garment.mesh(triangles=triangles)
    return Mesh.build(garment.scale * mesh.vertices, mesh.faces, garment.scale * np.asarray(mesh.pattern), mesh.places)


def build_material(fabric: str) -> AbstractMaterial:
    """Build the material of a published fabric, with a softer contact between layers.

    The material is orthotropic if the membrane stiffness differs between warp and weft.

    Raises:
        InvalidInput: the fabric is unknown, or its source gives no stiffness.
    """
    row = find_fabric(fabric)
    if row.membrane_warp is not None and row.membrane_warp != row.membrane_weft:
        return OrthotropicAEP(**_with_soft_contact(row.orthotropic()))
    return AEP(**_with_soft_contact(row.isotropic()))


def cloth_properties(fabric: str) -> dict[str, float]:
    """Return areal density [kg/m^2], bending stiffness [N m] and thickness [m]; defaults where the source has none."""
    row = find_fabric(fabric)
    return {
        "areal_density": row.areal_density or DEFAULT_AREAL_DENSITY_KG_PER_M2,
        "bending_stiffness": row.bending_warp or DEFAULT_BENDING_STIFFNESS_NM,
        "thickness": row.thickness or NOMINAL_THICKNESS_M,
    }


def nominal_properties(fabric: str) -> dict[str, float]:
    """Return nominal values of an episode's cloth: a membrane stiffness that is too high, and true values else.

    The nominal stiffness is ``NOMINAL_STIFFNESS_FACTOR`` times the true one along the warp.
    """
    row = find_fabric(fabric)
    sheet = {
        "bending_stiffness": cloth_properties(fabric)["bending_stiffness"],
        "bending_damping_time": BENDING_DAMPING_TIME_S,
    }
    if row.membrane_warp is not None:
        sheet["membrane_stiffness"] = NOMINAL_STIFFNESS_FACTOR * row.membrane_warp
    if row.poisson is not None:
        sheet["poisson_ratio"] = row.poisson
    return sheet


def _with_soft_contact(values: dict[str, Any]) -> dict[str, Any]:
    h = values["thickness"]
    return values | {
        "contact_stiffness": GARMENT_CONTACT_STIFFNESS_N_PER_M / h,
        "shear_stiffness": SHEAR_STIFFNESS_N_PER_M / h,
    }
