"""One episode: the fabric, everything that acts on it, the grippers, the sensor; and its simulation."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from torchcloth.errors import InvalidInput

from .air import AddedMass, AirSpec, Drag, LinearDrag
from .flex_sheet import SheetSpec, bilinear, grid
from .force_terms import Hook
from .mass_distribution import Weight, WeightSpec
from .membrane import Membrane, MembraneSpec
from .motions import Motion
from .mujoco_cloth import Grip, MujocoCloth, Result, Slip
from .plate import Moments, Plate, PlateSpec
from .sensor import SensorSpec
from .table_contact import Table, TableSpec

Array = np.ndarray
SETTLING = {False: 1.2, True: 0.1}  # s; on a table there is little to settle
BRAKE = 12.0  # 1/s


@dataclass(frozen=True)
class GripSpec:
    """How the robot holds and moves the cloth.

    Attributes:
        radius: m, of the patch that is said to be held; its edge lies ``wider`` m farther out.
        slip: m/(s N), mobility of the patch under a pull above ``hold`` N.
        regrasp: m, by which the patches lie further along u than said.
        backlash: m, play between the commanded and the true place, along each axis.
        base: m, by which the robot is believed to stand further along ``heading`` degrees than it does; ``yaw`` rad,
            by which it is believed to be turned, about the middle of the scene.
    """

    radius: float = 0.038
    wider: float = 0.0
    slip: float = 0.0
    hold: float = 0.3
    regrasp: float = 0.0
    backlash: float = 0.0
    base: float = 0.0
    heading: float = 0.0
    yaw: float = 0.0


@dataclass(frozen=True)
class Scene:
    """Everything about an episode but its motion and its seed. The defaults are the effect-free fabric.

    A knit, as in make_example.py: a lighter, stiffer sheet wrinkles at the size of any mesh, and then no two engines
    agree. Bending is the plate's; MuJoCo's hinges are off.
    """

    sheet: SheetSpec = field(
        default_factory=lambda: SheetSpec(0.30, 0.30, areal_density=0.25, membrane_stiffness=120.0, damping_time=2e-4)
    )
    plate: PlateSpec = field(default_factory=lambda: PlateSpec(stiffness=6e-5, damping_time=0.015))
    membrane: MembraneSpec = field(default_factory=MembraneSpec)
    air: AirSpec = field(default_factory=AirSpec)
    weight: WeightSpec = field(default_factory=WeightSpec)
    table: TableSpec = field(default_factory=TableSpec)
    grip: GripSpec = field(default_factory=GripSpec)
    sensor: SensorSpec = field(default_factory=SensorSpec)

    @property
    def gripped(self) -> Scene:
        """The same, its vertices moved to where the patches end that are wider or lie further along than said.

        What is held are whole vertices: without this, a shift by half an edge would be none or one by a whole edge.

        Raises:
            InvalidInput: patches too small for that.
        """
        grip, sheet = self.grip, self.sheet
        if not (grip.wider or grip.regrasp):
            return self
        (u, v), reach = sheet.even.lines, grip.radius + 1e-9
        left, right = u[u <= reach].max(), u[u >= sheet.width - reach].min()
        below = v[v >= sheet.height - reach].min()
        wider, along = grip.wider, grip.regrasp
        ends_u = [0.0, left + along + wider, right + along - wider, sheet.width]
        ends_v = [0.0, below - wider, sheet.height]
        if min(left, sheet.height - below) == 0 or min(*np.diff(ends_u), *np.diff(ends_v)) < 0.2 * left:
            raise InvalidInput("grip", got=f"patches of {grip.radius:g} m, {along:g} m along and {wider:g} m wider")
        lines_u = np.interp(u, [0.0, left, right, sheet.width], ends_u)
        lines_v = np.interp(v, [0.0, below, sheet.height], ends_v)
        return replace(self, sheet=replace(sheet, lines_u=tuple(lines_u), lines_v=tuple(lines_v)))


def hooks(scene: Scene, table: bool) -> list[Hook]:
    """What acts on the cloth besides MuJoCo's membrane and weight; what is at zero is left out.

    Raises:
        InvalidInput: a wind without drag.
    """
    plate, air = scene.plate, scene.air
    if (air.wind or air.jet) and not (air.normal or air.tangential):
        raise InvalidInput("a wind that nothing resists", expected="a drag coefficient", remedy="add air.drag_n=1.2")
    found: list[Hook] = [Weight(scene.weight)] if scene.weight != WeightSpec() else []
    if plate.stiffness:
        found.append(Plate(plate))
    if plate.curl or plate.curl_weft or plate.friction or plate.crease:
        found.append(Moments(plate))
    if scene.membrane != MembraneSpec():
        found.append(Membrane(scene.membrane))
    if air.normal or air.tangential:
        found.append(Drag(air))
    if air.linear:
        found.append(LinearDrag(air.linear))
    if table:
        found.append(Table(scene.table))
    if air.added:
        found.append(AddedMass(air.added, air.density))
    return found


def stable_step(scene: Scene) -> float:
    """A safe step in s: 0.8 of the limit of the stiffest membrane and plate waves together.

    Damping included, but for the plate's where that is implicit (``Hook.viscous``).
    """
    sheet, plate, membrane = scene.sheet, scene.plate, scene.membrane
    h = sheet.shortest
    stiffer = 1 + max(membrane.shear, 0.0) + 0.2 * membrane.stiffening  # up to a strain of 10 %
    young = stiffer * sheet.membrane_stiffness + membrane.friction / membrane.threshold
    light = 1 + min(scene.weight.density, 0.0) + min(scene.weight.moisture, 0.0)
    stretch = 8 * young / (1 - sheet.poisson_ratio**2) / (light * sheet.areal_density * h**2)
    bent = (plate.stiffness * (1 + max(plate.weft, 0.0)) * (1 + plate.layer)) + plate.friction / plate.threshold
    bend = 64 * bent / (light * sheet.areal_density * h**4)
    explicit = plate.damping_time * bend if scene.air.added else 0.0
    damping = (sheet.damping_time + membrane.viscosity) * stretch + explicit
    omega = np.sqrt(stretch + bend)
    zeta = 0.5 * damping / omega
    return 0.8 * 2 / omega * (np.sqrt(1 + zeta**2) - zeta)


def simulate(scene: Scene, motion: Motion, step: float | None = None) -> Result:
    """The cloth at the motion's knots, brought to rest first; vertices as in ``scene.gripped``."""
    scene = scene.gripped
    dt = stable_step(scene) if step is None else step
    uv, _ = grid(scene.sheet)
    grips = {name: _grip(scene, motion, name) for name in motion.pose}
    # what remembers or slips starts at the first frame
    steady = replace(scene, weight=replace(scene.weight, moisture=0.0))
    settling = [hook for hook in hooks(steady, motion.table) if hook.settles]
    still = {
        name: replace(grip, t=np.array([0.0, 1.0]), pose=np.repeat(grip.pose[:1], 2, 0), slip=None)
        for name, grip in grips.items()
    }
    cloth = MujocoCloth(scene.sheet, dt, settling)
    rest = cloth.run(motion.start(uv), np.array([0.0, SETTLING[motion.table]]), still, brake=BRAKE).x[-1]
    return MujocoCloth(scene.sheet, dt, hooks(scene, motion.table)).run(rest, motion.t, grips)


def evenly(scene: Scene, x: Array) -> Array:
    """Positions [K, V, 3] m of a simulated scene at vertices that lie at even distances: places to compare."""
    uv, _ = grid(scene.sheet.even)
    found = bilinear(scene.gripped.sheet, np.moveaxis(x, 0, 1).reshape(len(uv), -1), uv)[0]
    return np.moveaxis(found.reshape(len(uv), len(x), 3), 1, 0)


def _grip(scene: Scene, motion: Motion, name: str) -> Grip:
    spec = scene.grip
    said, _ = grid(scene.sheet.even)
    held = np.flatnonzero(np.linalg.norm(said - motion.held[name], axis=1) <= spec.radius + 1e-9)
    if not len(held):
        raise InvalidInput(f"grip {name!r} holds nothing", got=f"radius {spec.radius:g} m")
    pose = motion.pose[name].copy()
    pose[:, :3, 3] = play(pose[:, :3, 3], spec.backlash)
    return Grip(held, motion.t, pose, Slip(spec.slip, spec.hold) if spec.slip else None)


def play(path: Array, width: float) -> Array:
    """Where a body with backlash goes [K, 3] m that is commanded along ``path``: half the width behind."""
    out = path.copy()
    for k in range(1, len(path)):
        out[k] = np.clip(out[k - 1], path[k] - width / 2, path[k] + width / 2)
    return out


def believed(spec: GripSpec, pose: Array) -> Array:
    """The recorded poses [K, 4, 4] of commanded ones, when the robot's base is not where it is thought to be."""
    angle = np.deg2rad(spec.heading)
    turn = Rotation.from_rotvec([0.0, 0.0, spec.yaw]).as_matrix()
    pivot = np.array([0.5, 0.0, 0.0])
    out = pose.copy()
    out[:, :3, :3] = turn @ pose[:, :3, :3]
    out[:, :3, 3] = (pose[:, :3, 3] - pivot) @ turn.T + pivot
    out[:, :3, 3] += spec.base * np.array([np.cos(angle), np.sin(angle), 0.0])
    return out
