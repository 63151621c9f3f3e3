"""MuJoCo's 2-D flex: a Saint Venant-Kirchhoff membrane with quadratic hinges, as an MJCF file.

Sources: the XML reference (flex/elasticity); ``mj_flexPassiveBend`` and ``mj_inertiaBoxFluidModel`` in
src/engine/engine_passive.c; ``flex_bending`` of models that MuJoCo 4.0.0 compiled. Before 4.0 both moduli differed.

- Membrane: energy per area t (mu |e|^2 + lam/2 tr(e)^2) with the Green strain e. Hence E t is the membrane stiffness.
- Hinges: an edge of length L between triangles of area A1 and A2 has w = E t^3 / (12 (1 - nu^2)) L^2 / (A1 + A2),
  right for equilateral triangles. The thickness t is free, so it is chosen for the rigidity.
- ``damping`` is a time: it damps stretching and bending alike.
- There is no drag on triangles. A body has a box with the inertia of the body, and per axis of the world the force
  -1/2 rho side^2 |v| v. The inertia of a vertex, which never rotates, is free, so side^2 is C_n times its area.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
from scipy.sparse import coo_array, csr_array, diags
from scipy.sparse.linalg import eigsh

from .hinges import Hinges, find_hinges
from .report import Export, Parameter, describe_direction_spread
from .sheet import Sheet

STEP_OVER_STABILITY_LIMIT = 0.5  # of the stability limit at rest: a stretched sheet is stiffer
MIN_INERTIA_AREA_M2 = 1e-10  # of a vertex without drag: MuJoCo wants a positive inertia
CONTACT_RADIUS_OVER_THICKNESS = 0.5


def hinge_weights(hinges: Hinges, membrane_stiffness: float, poisson_ratio: float, thickness: float) -> np.ndarray:
    """Return w [N] N m of MuJoCo's hinges for a modulus of membrane_stiffness / thickness."""
    plate = membrane_stiffness * thickness**2 / (12 * (1 - poisson_ratio**2))
    return plate * hinges.length**2 / hinges.area


def flex_thickness(sheet: Sheet, hinges: Hinges) -> float:
    """Return the thickness [m] with which the mesh's hinges have the sheet's rigidity, as mean over all directions."""
    unit = hinges.rigidity(hinge_weights(hinges, sheet.membrane_stiffness, sheet.poisson_ratio, 1.0)).mean()
    return math.sqrt(sheet.bending / unit) if sheet.bending > 0 else sheet.thickness


def export_mujoco(sheet: Sheet) -> Export:
    """Return the sheet as MJCF."""
    hinges = find_hinges(sheet.rest, sheet.faces)
    thickness = flex_thickness(sheet, hinges)
    weights = hinge_weights(hinges, sheet.membrane_stiffness, sheet.poisson_ratio, thickness)
    damping = sheet.bending_damping or sheet.viscosity / sheet.membrane_stiffness
    step = max_stable_step(sheet, hinges, weights if sheet.bending > 0 else 0 * weights, damping)
    has_drag = sheet.air_density > 0 and sheet.drag_normal > 0
    parameters = [
        Parameter("flex/elasticity/young", sheet.membrane_stiffness / thickness, "Pa", "E h / thickness"),
        Parameter("flex/elasticity/poisson", sheet.poisson_ratio, "-", ""),
        Parameter("flex/elasticity/thickness", thickness, "m", "gives bending stiffness"),
        Parameter("flex/elasticity/damping", damping, "s", "of stretching and bending"),
        Parameter("body/inertial/mass", float(sheet.mass.sum()), "kg", "sum over the vertices"),
        Parameter("option/density", sheet.air_density if has_drag else 0.0, "kg/m^3", "of the air"),
        Parameter("option/timestep", step, "s", "half the stability limit"),
    ]
    notes = [*sheet.notes, *_list_losses(sheet, damping, has_drag)]
    if sheet.bending > 0:
        notes.append(describe_direction_spread(hinges.rigidity(weights)))
    return Export("mujoco", _write_xml(sheet, thickness, damping, step, has_drag, notes), parameters, notes)


def _list_losses(sheet: Sheet, damping: float, has_drag: bool) -> Iterable[str]:
    yield "the membrane is Saint Venant-Kirchhoff: as stiff at rest, in a strip 1.5 e stiffer at the strain e"
    if sheet.bending_damping > 0:
        yield (
            f"MuJoCo has one damping time: that of bending, {damping:.3g} s, also damps stretching with "
            f"{damping * sheet.membrane_stiffness:.3g} N s/m (the cloth has {sheet.viscosity:.3g})"
        )
    if has_drag:
        yield (
            f"drag acts on vertices along the axes of the world, whatever the cloth's normal: right broadside, too "
            f"much (C_n = {sheet.drag_normal:.3g}) edgewise; the air's density acts on all bodies of the scene"
        )
    if sheet.drag_tangential > 0:
        yield f"tangential drag C_t = {sheet.drag_tangential:.3g} is left out"


def max_stable_step(sheet: Sheet, hinges: Hinges, weights: np.ndarray, damping: float) -> float:
    """Return half the largest step [s] of MuJoCo's explicit integration about the sheet at rest."""
    stiffness = _membrane_matrix(sheet) + _hinge_matrix(sheet, hinges, weights)
    scale = diags(np.repeat(1 / np.sqrt(sheet.mass), 3))
    start = np.cos(np.arange(3.0 * len(sheet.mass)) ** 2)  # the same at every call
    omega = math.sqrt(eigsh(scale @ stiffness @ scale, k=1, v0=start, return_eigenvectors=False)[0])
    zeta = damping * omega / 2
    return STEP_OVER_STABILITY_LIMIT * 2 / omega * (math.sqrt(1 + zeta**2) - zeta)


def _membrane_matrix(sheet: Sheet) -> csr_array:
    """Return the stiffness matrix [3 V, 3 V] N/m of the membrane at rest."""
    a, b, c = (sheet.rest[sheet.faces[:, k]] for k in range(3))
    along = (b - a) / np.linalg.norm(b - a, axis=1, keepdims=True)
    across = np.cross(np.cross(b - a, c - a), along)
    frame = np.stack([along, across / np.linalg.norm(across, axis=1, keepdims=True)], 1)  # [F, 2, 3]
    edges = np.einsum("fik,jfk->fij", frame, np.stack([b - a, c - a]))  # columns: both edges
    gradient = np.linalg.inv(edges)  # [F, 2, 2], rows: shape functions of corners 1 and 2
    gradient = np.concatenate([-gradient.sum(1, keepdims=True), gradient], 1)
    area = 0.5 * np.linalg.det(edges)
    strain = np.zeros((len(area), 3, 3, 3))  # [F, component, corner, axis]
    for row, (i, j) in enumerate(((0, 0), (1, 1))):
        strain[:, row] = gradient[:, :, i, None] * frame[:, None, j]
    strain[:, 2] = gradient[:, :, 1, None] * frame[:, None, 0] + gradient[:, :, 0, None] * frame[:, None, 1]
    tangent = np.diag([sheet.lam + 2 * sheet.mu] * 2 + [sheet.mu])
    tangent[0, 1] = tangent[1, 0] = sheet.lam
    form = strain.reshape(len(area), 3, 9)
    blocks = np.einsum("fai,ab,fbj,f->fij", form, tangent, form, np.abs(area))
    return _assemble(blocks, sheet.faces, len(sheet.rest))


def _hinge_matrix(sheet: Sheet, hinges: Hinges, weights: np.ndarray) -> csr_array:
    """Return the stiffness matrix [3 V, 3 V] N/m of quadratic hinges: the same in every direction of space."""
    a, b, c, d = (sheet.rest[hinges.vertices[:, k]] for k in range(4))
    length = hinges.length[:, None]
    rows = np.zeros((len(a), 4))
    for column, corner in ((2, c), (3, d)):
        x = ((corner - a) * (b - a)).sum(1, keepdims=True) / length**2
        height = np.linalg.norm(corner - a - x * (b - a), axis=1)
        rows[:, column] = 1 / height
        rows[:, 0] -= (1 - x[:, 0]) / height
        rows[:, 1] -= x[:, 0] / height
    blocks = np.einsum("ei,ej,e,ab->eiajb", rows, rows, weights, np.eye(3)).reshape(len(a), 12, 12)
    return _assemble(blocks, hinges.vertices, len(sheet.rest))


def _assemble(blocks: np.ndarray, vertices: np.ndarray, count: int) -> csr_array:
    dofs = (3 * vertices[:, :, None] + np.arange(3)).reshape(len(vertices), -1)
    rows, columns = (np.broadcast_to(d, blocks.shape) for d in (dofs[:, :, None], dofs[:, None, :]))
    return coo_array((blocks.ravel(), (rows.ravel(), columns.ravel())), shape=(3 * count, 3 * count)).tocsr()


def _write_xml(
    sheet: Sheet, thickness: float, damping: float, step: float, has_drag: bool, notes: Iterable[str]
) -> str:
    area = sheet.vertex_area * sheet.drag_normal if has_drag else np.full(len(sheet.mass), MIN_INERTIA_AREA_M2)
    inertia = sheet.mass * np.maximum(area, MIN_INERTIA_AREA_M2) / 6  # of a cube whose side is the root of the area
    drag = f' density="{sheet.air_density:.9g}" wind="{_join(sheet.wind)}"' if has_drag else ""
    joints = "".join(f'<joint type="slide" axis="{axis}"{{}}/>' for axis in ("1 0 0", "0 1 0", "0 0 1"))
    bodies = "\n".join(
        f'    <body name="cloth_{i}" pos="{_join(p)}"><inertial pos="0 0 0" mass="{m:.9g}" diaginertia="{s} {s} {s}"/>'
        + joints.replace("{}", f' damping="{sheet.damping_rate * m:.9g}"' if sheet.damping_rate > 0 else "")
        + "</body>"
        for i, (p, m, s) in enumerate(zip(sheet.rest, sheet.mass, (f"{k:.9g}" for k in inertia), strict=True))
    )
    names = " ".join(f"cloth_{i}" for i in range(len(sheet.mass)))
    grasps = "".join(
        f'\n    <numeric name="grasp_{name}" data="{_join(index)}"/>' for name, index in sheet.grasps.items()
    )
    elastic = "both" if sheet.bending > 0 else "stretch"
    comments = "\n".join(f"  {note}".replace("--", "- -") for note in notes)
    return f"""<mujoco model="cloth">
  <!-- Cloth identified by torchcloth, in SI units, for MuJoCo 4.0 or newer. What is not known, or not expressed:
{comments}
  -->
  <option timestep="{step:.6g}" integrator="Euler" gravity="{_join(sheet.gravity)}"{drag}/>
  <size memory="64M"/>
  <custom>
    <numeric name="drag_normal" data="{sheet.drag_normal:.9g}"/>
    <numeric name="areal_density" data="{sheet.areal_density:.9g}"/>
    <numeric name="membrane_stiffness" data="{sheet.membrane_stiffness:.9g}"/>
    <numeric name="bending_stiffness" data="{sheet.bending:.9g}"/>{grasps}
  </custom>
  <worldbody>
{bodies}
  </worldbody>
  <deformable>
    <flex name="cloth" dim="2" radius="{CONTACT_RADIUS_OVER_THICKNESS * sheet.thickness:.6g}" body="{names}"
      element="{_join(sheet.faces.ravel())}">
      <contact selfcollide="none"/>
      <elasticity young="{sheet.membrane_stiffness / thickness:.9g}" poisson="{sheet.poisson_ratio:.9g}"
        thickness="{thickness:.9g}" damping="{damping:.9g}" elastic2d="{elastic}"/>
    </flex>
  </deformable>
  <keyframe>
    <key name="first_frame" qpos="{_join((sheet.initial - sheet.rest).ravel())}"/>
  </keyframe>
</mujoco>
"""


def _join(numbers: Iterable[float]) -> str:
    return " ".join(f"{value:.9g}" for value in numbers)
