"""USD: a mesh with surface-deformable attributes of two dialects, as ``.usda`` text.

- ``physics:`` (the AOUSD proposal for deformables, as Newton 1.8 reads it): Young's modulus and Poisson's ratio of
  plane stress, the mesh's thickness, and the rigidity of the plate [N m] as surfaceBendStiffness.
- ``omniphysics:`` (PhysX and Isaac Sim; omni/schema/source/omniUsdPhysicsDeformableSchema/schema.usda). Its solver has
  a fixed-corotated membrane with the Lame parameters of three dimensions (FEMClothUtil.cuh), so E and nu are converted:
  nu' = nu / (1 + nu) and E' = E (1 + 2 nu) / (1 + nu)^2 give the wanted mu and lam. An edge of length L between
  triangles of area A1 and A2 has w = surfaceBendStiffness h^3 3 L^2 / (2 (A1 + A2))
  (``updateFlexuralStiffnessPerTrianglePair`` in PxgFEMCloth.cpp).
"""

from __future__ import annotations

import json
from collections.abc import Iterable

import numpy as np

from .hinges import find_hinges
from .report import Export, Parameter, describe_direction_spread
from .sheet import Sheet


def physx_elasticity(sheet: Sheet) -> tuple[float, float]:
    """Return E [Pa] and nu whose three-dimensional Lame parameters times the thickness are the sheet's."""
    nu = sheet.lam / (2 * (sheet.lam + sheet.mu))
    return 2 * sheet.mu * (1 + nu) / sheet.thickness, nu


def export_usd(sheet: Sheet) -> Export:
    """Return the sheet as a USD layer."""
    hinges = find_hinges(sheet.rest, sheet.faces)
    unit = hinges.rigidity(1.5 * sheet.thickness**3 * hinges.length**2 / hinges.area) if len(hinges.length) else None
    bend = 0.0 if unit is None else sheet.bending / float(unit.mean())
    youngs, poisson = physx_elasticity(sheet)
    material = {
        "physics:density": (sheet.areal_density / sheet.thickness, "kg/m^3", "mass per area / h"),
        "physics:youngsModulus": (sheet.membrane_stiffness / sheet.thickness, "Pa", "of plane stress"),
        "physics:poissonsRatio": (sheet.poisson_ratio, "-", ""),
        "physics:surfaceBendStiffness": (sheet.bending, "N m", "rigidity of the plate"),
        "omniphysics:density": (sheet.areal_density / sheet.thickness, "kg/m^3", ""),
        "omniphysics:youngsModulus": (youngs, "Pa", "of plane strain"),
        "omniphysics:poissonsRatio": (poisson, "-", "of plane strain"),
        "omniphysics:surfaceThickness": (sheet.thickness, "m", ""),
        "omniphysics:surfaceBendStiffness": (bend, "Pa", "bending of this mesh"),
    }
    parameters = [Parameter(name, *entry) for name, entry in material.items()]
    notes = [*sheet.notes, *_list_losses(sheet)]
    if sheet.bending > 0 and unit is not None:
        notes.append(f"PhysX: {describe_direction_spread(unit)}")
    return Export(
        "usd", _write_usda(sheet, {name: entry[0] for name, entry in material.items()}, notes), parameters, notes
    )


def _list_losses(sheet: Sheet) -> Iterable[str]:
    yield "checked against the solvers' source and for syntax, not by simulation: PhysX needs a GPU"
    if sheet.drag_normal > 0:
        yield f"drag (C_n = {sheet.drag_normal:.3g}) and air are left out: neither dialect has them"
    if sheet.bending_damping > 0 or sheet.viscosity > 0 or sheet.damping_rate > 0:
        yield "damping is left out: neither dialect has a viscous time of bending or of the membrane"
    yield (
        "Newton 1.8 imports physics: with tri_ke = E h / (1 - nu^2) and tri_ka = 0, a membrane "
        f"{2 / (1 - sheet.poisson_ratio**2):.2f} times too stiff: give Newton the JSON file of --to newton"
    )
    if not np.allclose(sheet.mass, sheet.areal_density * sheet.vertex_area, rtol=1e-3):
        yield "masses that the vertices have beyond the areal density, as of a hem, are spread over the sheet"


def _write_usda(sheet: Sheet, material: dict[str, float], notes: Iterable[str]) -> str:
    gravity = float(np.linalg.norm(sheet.gravity))
    direction = sheet.gravity / gravity if gravity > 0 else np.array([0.0, 0.0, -1.0])
    attributes = "\n".join(f"        float {name} = {value:.9g}" for name, value in material.items())
    rest, faces = _tuples(sheet.rest), _tuples(sheet.faces)
    low, high = _tuples([sheet.initial.min(0), sheet.initial.max(0)]), float(sheet.mass.sum())
    grasps = "".join(_grasp(name, index) for name, index in sheet.grasps.items())
    return f"""#usda 1.0
(
    defaultPrim = "World"
    doc = "Cloth identified by torchcloth, in SI units."
    customLayerData = {{
        dictionary torchcloth = {{
            string[] not_expressed = [{", ".join(json.dumps(note) for note in notes)}]
            double membrane_stiffness = {sheet.membrane_stiffness:.9g}
            double bending_stiffness = {sheet.bending:.9g}
            double bending_damping_time = {sheet.bending_damping:.9g}
            double areal_density = {sheet.areal_density:.9g}
            double drag_normal = {sheet.drag_normal:.9g}
            double air_density = {sheet.air_density:.9g}
        }}
    }}
    kilogramsPerUnit = 1
    metersPerUnit = 1
    upAxis = "Z"
)

def Xform "World"
{{
    def PhysicsScene "physicsScene"
    {{
        vector3f physics:gravityDirection = {_tuples([direction])[1:-1]}
        float physics:gravityMagnitude = {gravity:.9g}
    }}

    def Material "fabric" (
        prepend apiSchemas = ["PhysicsMaterialAPI", "PhysicsSurfaceDeformableMaterialAPI",
            "OmniPhysicsBaseMaterialAPI", "OmniPhysicsDeformableMaterialAPI", "OmniPhysicsSurfaceDeformableMaterialAPI"]
    )
    {{
{attributes}
    }}

    def Mesh "cloth" (
        prepend apiSchemas = ["MaterialBindingAPI", "PhysicsCollisionAPI",
            "PhysicsDeformableBodyAPI", "PhysicsSurfaceDeformableSimAPI",
            "OmniPhysicsBodyAPI", "OmniPhysicsDeformableBodyAPI", "OmniPhysicsSurfaceDeformableSimAPI"]
    )
    {{
        rel material:binding:physics = </World/fabric> (
            bindMaterialAs = "weakerThanDescendants"
        )
        uniform bool doubleSided = 1
        uniform token subdivisionScheme = "none"
        float3[] extent = {low}
        int[] faceVertexCounts = [{", ".join(["3"] * len(sheet.faces))}]
        int[] faceVertexIndices = [{", ".join(map(str, sheet.faces.ravel()))}]
        point3f[] points = {_tuples(sheet.initial)}
        float[] physics:thicknesses = [{sheet.thickness:.9g}]
        uniform token physics:thicknesses:elementType = "constant"
        point3f[] physics:restShapePoints = {rest}
        int3[] physics:restTriVertexIndices = {faces}
        float omniphysics:mass = {high:.9g}
        point3f[] omniphysics:restShapePoints = {rest}
        int3[] omniphysics:restTriVtxIndices = {faces}
        uniform token omniphysics:restBendAnglesDefault = "flatDefault"
{grasps}    }}
}}
"""


def _grasp(name: str, index: np.ndarray) -> str:
    return f"""
        def GeomSubset "grasp_{name}"
        {{
            uniform token elementType = "point"
            uniform token familyName = "grasp"
            int[] indices = [{", ".join(map(str, index))}]
        }}
"""


def _tuples(rows: Iterable[Iterable[float]]) -> str:
    return "[" + ", ".join("(" + ", ".join(f"{value:.9g}" for value in row) + ")" for row in rows) + "]"
