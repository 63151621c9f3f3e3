"""One episode: the fabric, everything that acts on it, the grippers, the sensor; and its simulation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from torchcloth.errors import InvalidInput

from .air import AddedMass, AirSpec, LinearDrag, QuadraticDrag
from .flex_sheet import STEP_SAFETY_FACTOR, SheetSpec, interpolate_bilinear, sheet_mesh
from .force_terms import ForceTerm
from .mass_distribution import MassDistribution, MassSpec
from .membrane import Membrane, MembraneSpec
from .motions import PIVOT_M, Motion
from .mujoco_cloth import Grip, MujocoCloth, Result, Slip, hold_grips
from .plate import InelasticBending, PlateBending, PlateSpec
from .sensor import SensorSpec
from .table_contact import TableContact, TableSpec

Array = np.ndarray
HANGING_SETTLING_S, TABLE_SETTLING_S = 1.2, 0.1  # on a table there is little to settle
SETTLING_DAMPING_PER_S = 12.0
MIN_EDGE_FRACTION = 0.2  # of the held length, that displaced grid lines must keep


@dataclass(frozen=True)
class GripSpec:
    """How the robot holds and moves the cloth, and what it reports of that.

    Attributes:
        radius: m, of the patch that the recording says is held.
        extra_radius: m, by which the edge of the true patch lies farther out.
        slip: m/(s N), mobility of the patch under a pull above ``slip_threshold``.
        slip_threshold: N.
        regrasp: m, by which the true patches lie further along u than the recording says.
        backlash: m, play between the commanded and the true position, along each axis.
        base: m, by which the robot is believed to stand further along ``heading`` than it does.
        heading: degrees (0: +x, 90: +y).
        yaw: rad, by which the robot is believed to be turned, about the middle of the scene.
    """

    radius: float = 0.038
    extra_radius: float = 0.0
    slip: float = 0.0
    slip_threshold: float = 0.3
    regrasp: float = 0.0
    backlash: float = 0.0
    base: float = 0.0
    heading: float = 0.0
    yaw: float = 0.0


@dataclass(frozen=True)
class Scene:
    """Everything about an episode but its motion and its seed. The defaults are the effect-free fabric.

    The fabric is a knit, as in make_example.py: a lighter, stiffer sheet wrinkles at the size of any mesh, and then no
    two engines agree. The plate computes bending; MuJoCo's hinges are off.

    Attributes:
        sheet: mesh and isotropic membrane.
        plate: bending.
        membrane: deviations from the isotropic membrane.
        air: drag, wind and added mass.
        mass: masses beyond the areal density, and the direction of gravity.
        table: friction and adhesion.
        grip: how the robot holds the cloth.
        sensor: the depth camera.
    """

    sheet: SheetSpec = field(
        default_factory=lambda: SheetSpec(0.30, 0.30, areal_density=0.25, membrane_stiffness=120.0, damping_time=2e-4)
    )
    plate: PlateSpec = field(default_factory=lambda: PlateSpec(stiffness=6e-5, damping_time=0.015))
    membrane: MembraneSpec = field(default_factory=MembraneSpec)
    air: AirSpec = field(default_factory=AirSpec)
    mass: MassSpec = field(default_factory=MassSpec)
    table: TableSpec = field(default_factory=TableSpec)
    grip: GripSpec = field(default_factory=GripSpec)
    sensor: SensorSpec = field(default_factory=SensorSpec)

    @property
    def aligned_to_patches(self) -> Scene:
        """The same scene with grid lines moved to the edges of the true patches.

        Grippers hold whole vertices. Without this, a shift by half an edge would be none or one by a whole edge.

        Raises:
            InvalidInput: patches that are too small for that.
        """
        grip, sheet = self.grip, self.sheet
        if not (grip.extra_radius or grip.regrasp):
            return self
        (u, v), reach = sheet.evenly_spaced.grid_lines, grip.radius + 1e-9
        left, right = u[u <= reach].max(), u[u >= sheet.width - reach].min()
        below = v[v >= sheet.height - reach].min()
        wider, along = grip.extra_radius, grip.regrasp
        ends_u = [0.0, left + along + wider, right + along - wider, sheet.width]
        ends_v = [0.0, below - wider, sheet.height]
        shortest = min(*np.diff(ends_u), *np.diff(ends_v))
        if min(left, sheet.height - below) == 0 or shortest < MIN_EDGE_FRACTION * left:
            raise InvalidInput("grip", got=f"patches of {grip.radius:g} m, {along:g} m along and {wider:g} m wider")
        lines_u = np.interp(u, [0.0, left, right, sheet.width], ends_u)
        lines_v = np.interp(v, [0.0, below, sheet.height], ends_v)
        return replace(self, sheet=replace(sheet, lines_u=tuple(lines_u), lines_v=tuple(lines_v)))


def make_force_terms(scene: Scene, on_table: bool) -> list[ForceTerm]:
    """Return what acts on the cloth besides MuJoCo's membrane and weight, without what is at zero.

    Raises:
        InvalidInput: a wind without drag.
    """
    plate, air = scene.plate, scene.air
    if (air.wind or air.jet) and not (air.normal or air.tangential):
        raise InvalidInput("a wind that nothing resists", expected="a drag coefficient", remedy="add air.drag_n=1.2")
    terms: list[ForceTerm] = [MassDistribution(scene.mass)] if scene.mass != MassSpec() else []
    if plate.stiffness:
        terms.append(PlateBending(plate))
    if plate.curl or plate.curl_weft or plate.friction or plate.crease:
        terms.append(InelasticBending(plate))
    if scene.membrane != MembraneSpec():
        terms.append(Membrane(scene.membrane))
    if air.normal or air.tangential:
        terms.append(QuadraticDrag(air))
    if air.linear:
        terms.append(LinearDrag(air.linear))
    if on_table:
        terms.append(TableContact(scene.table))
    if air.added_depth:
        terms.append(AddedMass(air.added_depth, air.density))
    return terms


def stable_step(scene: Scene) -> float:
    """Return a safe step [s]: 0.8 of the limit of the stiffest membrane and plate waves together.

    Damping is included, but not the plate's where it is implicit (``ForceTerm.damping_matrix``).
    """
    sheet, plate, membrane = scene.sheet, scene.plate, scene.membrane
    h = sheet.min_spacing
    stiffer = 1 + max(membrane.shear, 0.0) + 0.2 * membrane.stiffening  # up to a strain of 10 %
    young = stiffer * sheet.membrane_stiffness + membrane.friction / membrane.threshold
    lightest = 1 + min(scene.mass.density, 0.0) + min(scene.mass.moisture, 0.0)
    stretch = 8 * young / (1 - sheet.poisson_ratio**2) / (lightest * sheet.areal_density * h**2)
    rigidity = (plate.stiffness * (1 + max(plate.weft, 0.0)) * (1 + plate.layer)) + plate.friction / plate.threshold
    bend = 64 * rigidity / (lightest * sheet.areal_density * h**4)
    explicit = plate.damping_time * bend if scene.air.added_depth else 0.0
    damping = (sheet.damping_time + membrane.viscosity) * stretch + explicit
    omega = np.sqrt(stretch + bend)
    zeta = 0.5 * damping / omega
    return STEP_SAFETY_FACTOR * 2 / omega * (np.sqrt(1 + zeta**2) - zeta)


def simulate(scene: Scene, motion: Motion, step: float | None = None) -> Result:
    """Bring the cloth to rest, then simulate the motion at its knots.

    The result's vertices are those of ``scene.aligned_to_patches``.
    """
    scene = scene.aligned_to_patches
    dt = stable_step(scene) if step is None else step
    uv, _ = sheet_mesh(scene.sheet)
    grips = {name: _make_grip(scene, motion, name) for name in motion.pose}

    # terms that slip or have a memory start at the first frame
    dry = replace(scene, mass=replace(scene.mass, moisture=0.0))
    settling_terms = [term for term in make_force_terms(dry, motion.on_table) if term.acts_while_settling]
    seconds = TABLE_SETTLING_S if motion.on_table else HANGING_SETTLING_S
    cloth = MujocoCloth(scene.sheet, dt, settling_terms)
    settled = cloth.run(
        motion.initial_shape(uv), np.array([0.0, seconds]), hold_grips(grips), damping_rate=SETTLING_DAMPING_PER_S
    )
    terms = make_force_terms(scene, motion.on_table)
    return MujocoCloth(scene.sheet, dt, terms).run(settled.x[-1], motion.t, grips)


def settle_and_move(scene: Scene, x0: Array, grips: Mapping[str, Grip], t: Array) -> Result:
    """Let cloth that hangs freely settle from positions x0 [V, 3] m, then move its grips; frames are at t [T] s."""
    step, terms = stable_step(scene), make_force_terms(scene, on_table=False)
    settling_terms = [term for term in terms if term.acts_while_settling]
    settled = MujocoCloth(scene.sheet, step, settling_terms).run(
        x0, np.array([0.0, HANGING_SETTLING_S]), hold_grips(grips), damping_rate=SETTLING_DAMPING_PER_S
    )
    return MujocoCloth(scene.sheet, step, terms).run(settled.x[-1], t, grips)


def resample_evenly(scene: Scene, x: Array) -> Array:
    """Return positions [K, V, 3] m of a simulated scene at evenly spaced vertices, which scenes share."""
    uv, _ = sheet_mesh(scene.sheet.evenly_spaced)
    flat = np.moveaxis(x, 0, 1).reshape(len(uv), -1)
    resampled = interpolate_bilinear(scene.aligned_to_patches.sheet, flat, uv)[0]
    return np.moveaxis(resampled.reshape(len(uv), len(x), 3), 1, 0)


def _make_grip(scene: Scene, motion: Motion, name: str) -> Grip:
    spec = scene.grip
    uv, _ = sheet_mesh(scene.sheet.evenly_spaced)
    vertices = np.flatnonzero(np.linalg.norm(uv - motion.grasp_points[name], axis=1) <= spec.radius + 1e-9)
    if not len(vertices):
        raise InvalidInput(f"grip {name!r} holds nothing", got=f"radius {spec.radius:g} m")
    pose = motion.pose[name].copy()
    pose[:, :3, 3] = apply_backlash(pose[:, :3, 3], spec.backlash)
    return Grip(vertices, motion.t, pose, Slip(spec.slip, spec.slip_threshold) if spec.slip else None)


def apply_backlash(path: Array, width: float) -> Array:
    """Return the path [K, 3] m of a body with backlash that is commanded along ``path``: half the width behind."""
    out = path.copy()
    for k in range(1, len(path)):
        out[k] = np.clip(out[k - 1], path[k] - width / 2, path[k] + width / 2)
    return out


def recorded_poses(spec: GripSpec, pose: Array) -> Array:
    """Return the recorded poses [K, 4, 4] m of commanded ones, with the error of the robot's believed base."""
    angle = np.deg2rad(spec.heading)
    turn = Rotation.from_rotvec([0.0, 0.0, spec.yaw]).as_matrix()
    out = pose.copy()
    out[:, :3, :3] = turn @ pose[:, :3, :3]
    out[:, :3, 3] = (pose[:, :3, 3] - PIVOT_M) @ turn.T + PIVOT_M
    out[:, :3, 3] += spec.base * np.array([np.cos(angle), np.sin(angle), 0.0])
    return out
