"""Draw and simulate a stranger's bench: one or two arms hold a sheet, move it once, and two or more things are off.

The cloth is MuJoCo's. A bench is a function of its seed alone. An arm carries the sheet by a bar along its upper edge,
two arms hold two corners, or an arm holds one corner. No grip is the clamp that the stranger states: the cloth turns in
it as in a hinge, or it holds more. Further faults come on top. ``bench_files`` renders the images and writes the files.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from torchcloth.errors import InvalidInput
from torchcloth.robots import Scene as Rig  # pyright: ignore[reportMissingImports] - mapped from robots/
from torchcloth.robots import Table, bimanual_rig, load  # pyright: ignore[reportMissingImports] - mapped from robots/

from .air import AirSpec
from .flex_sheet import SheetSpec, sheet_mesh
from .motions import (
    CLEARANCE_M,
    HANGING_MOTIONS,
    KNOT_PERIOD_S,
    STANDSTILL_S,
    TAUT_DISTANCE_RATIO,
    minimum_jerk,
    rotations_about_z,
)
from .mujoco_cloth import Grip, Result
from .plate import PlateSpec
from .rig_recording import (
    AREAL_DENSITY_RANGE,
    BENDING_STIFFNESS_RANGE,
    CAMERA_SHIFT_M,
    CLAMP_EXTRA_RADIUS_M,
    DENSITY_ERROR,
    DRAG_RANGE,
    DROPPED_FRACTION,
    GAP_FRAMES,
    MAX_JITTER_STD_S,
    MAX_LAG_S,
    MEMBRANE_STIFFNESS_RANGE,
    MOTIONS,
    POISSON_RANGE,
    jitter_stamps,
    true_parameters,
)
from .scene import Scene, settle_and_move
from .swing_motion import Swing, hold_from_above, measure_joint_usage, move_origin, sample_poses

Array = np.ndarray
HOLDINGS = ("bar", "corners", "corner")  # of the seeds, in turn
CAMERAS = ("kinect", "realsense")
ARM_MODEL, ARM_TOOL = "rizon4", "tcp_closed"
ONE_ARM_NAME = "gripper"
ARM_SIDES = {"left": 1.0, "right": -1.0}  # sign of y
STATED_GRIP_RADIUS_M = 0.012  # what ``torchcloth new`` assumes
TOWEL_WIDTH_M, TOWEL_HEIGHT_M = 0.4, 0.3
SIDE_RANGE_M, ASPECT_RANGE = (0.28, 0.34), (0.8, 1.0)
# A square that hangs from a corner looks the same with its sides exchanged: no cloud shows which is which.
CORNER_SIDE_RANGE_M, CORNER_ASPECT_RANGE = (0.30, 0.36), (0.65, 0.78)
TOP_EDGE_M = (0.50, 0.0)  # x and y of the middle of what is held, at rest
HEADING_RANGE_RAD = 0.35
MAX_YAW_RAD = 0.7  # of the motion "turn", which no camera sees if it goes to a right angle
SHAKE_TILT_RAD = np.deg2rad(45.0)  # of the motion "shake", from the vertical
STILL_AFTERWARDS_S = 0.35  # the cloth swings on
BULGE_STD_M = 2e-3  # of the flat sheet before it settles, since a plane is a bifurcation
CORNER_FOLD_M = 0.02  # a flat sheet does not hang from a corner: its sides fold towards each other
GRIPPER_SHIFT_RANGE_M = (1e-3, 2e-3)
MAX_CAMERA_ROTATION_RAD = np.deg2rad(0.5)
ROBOT_LOG_MARGIN_S = 0.5  # of the joints before and after the motion
IK_ATTEMPTS = 20
IK_TOLERANCE_M = 1e-6


@dataclass(frozen=True)
class BenchSize:
    """Sizes of a bench.

    Attributes:
        spacing: of the simulated vertices [m].
        rate: of the camera [Hz].
        shrink: factor by which the stored images are smaller than the camera's.
    """

    spacing: float = 0.015
    rate: float = 30.0
    shrink: int = 2


@dataclass
class Faults:
    """What is off at a bench; the functions of ``FAULTS`` set it.

    Attributes:
        held_depth: to which the cloth is held, from an edge or a corner [m]; 0: as by a hinge.
        lag: by which the stamps of the images are late [s].
        jitter: standard deviation of each stamp [s].
        camera_shift: [3] m, from the true to the stated place of what the camera sees.
        camera_rotation: [3] rad, rotation vector by which this is turned about the middle of the cloth.
        gripper_shift: [3] m, from the tool to the cloth that it holds, in the hold's axes, by gripper.
        mass: what the scale shows over the true mass.
        has_gaps, is_frozen: faults of the images.
    """

    held_depth: float = 0.0
    lag: float = 0.0
    jitter: float = 0.0
    camera_shift: Array = field(default_factory=lambda: np.zeros(3))
    camera_rotation: Array = field(default_factory=lambda: np.zeros(3))
    gripper_shift: dict[str, Array] = field(default_factory=dict)
    mass: float = 1.0
    has_gaps: bool = False
    is_frozen: bool = False


@dataclass(frozen=True)
class StrangerBench:
    """A simulated bench, and what is hidden in it.

    Attributes:
        seed: of everything.
        holding: one of ``HOLDINGS``.
        camera: one of ``CAMERAS``.
        motion: its name.
        faults: each with its size and unit.
        truth: true values by the name of the fitted parameter.
        sheet: the simulated sheet.
        mass: that the stranger's scale shows [kg].
        places: [2] m by gripper, pattern places that the stranger says are held.
        rig: the arms by name of the gripper.
        joint_times: [K] s, of the log of the joints.
        joints: [K, J] rad by gripper.
        hold: [T, 4, 4] m by gripper, where the cloth is held when the images are taken; y along the held edge.
        light_times: [T] s, when the light of the images came.
        stamps: [T] s, what the camera says.
        x: [T, V, 3] m, true vertices in the images.
        believed_from_true: [4, 4] m, by which the stated camera displaces what it sees.
        size: of meshes and images.
    """

    seed: int
    holding: str
    camera: str
    motion: str
    faults: dict[str, str]
    truth: dict[str, float]
    sheet: SheetSpec
    mass: float
    places: dict[str, Array]
    rig: Rig
    joint_times: Array
    joints: dict[str, Array]
    hold: dict[str, Array]
    light_times: Array
    stamps: Array
    x: Array
    believed_from_true: Array
    size: BenchSize


# -- faults -----------------------------------------------------------------------------------------------------------


def _hinge_or_clamp(faults: Faults, rng: np.random.Generator) -> str:
    if rng.random() < 0.5:
        faults.held_depth = 0.0
        return "hinge"
    faults.held_depth = STATED_GRIP_RADIUS_M + CLAMP_EXTRA_RADIUS_M
    return f"clamp, {1e3 * CLAMP_EXTRA_RADIUS_M:.0f} mm wider"


def _lag(faults: Faults, rng: np.random.Generator) -> str:
    faults.lag = rng.uniform(0, MAX_LAG_S)
    return f"{1e3 * faults.lag:.0f} ms"


def _jitter(faults: Faults, rng: np.random.Generator) -> str:
    faults.jitter = rng.uniform(0, MAX_JITTER_STD_S)
    return f"{1e3 * faults.jitter:.0f} ms"


def _camera(faults: Faults, rng: np.random.Generator) -> str:
    angle = rng.uniform(0, MAX_CAMERA_ROTATION_RAD)
    faults.camera_shift = CAMERA_SHIFT_M * _draw_direction(rng)
    faults.camera_rotation = angle * _draw_direction(rng)
    return f"{1e3 * CAMERA_SHIFT_M:.0f} mm and {np.rad2deg(angle):.1f} deg"


def _gripper(faults: Faults, rng: np.random.Generator) -> str:
    shift = rng.uniform(*GRIPPER_SHIFT_RANGE_M)
    faults.gripper_shift = {name: shift * _draw_direction(rng) for name in (ONE_ARM_NAME, *ARM_SIDES)}
    return f"{1e3 * shift:.1f} mm beside"


def _mass(faults: Faults, rng: np.random.Generator) -> str:
    error = rng.choice([-DENSITY_ERROR, DENSITY_ERROR])
    faults.mass = 1 + error
    return f"{100 * error:+.0f} %"


def _drop_images(faults: Faults, rng: np.random.Generator) -> str:
    faults.has_gaps = True
    return f"{GAP_FRAMES} in a row and {100 * DROPPED_FRACTION:.0f} %"


def _freeze_images(faults: Faults, rng: np.random.Generator) -> str:
    faults.is_frozen = True
    return f"{GAP_FRAMES} in a row"


def _draw_direction(rng: np.random.Generator) -> Array:
    vector = rng.standard_normal(3)
    return vector / np.linalg.norm(vector)


FURTHER_FAULTS: dict[str, Callable[[Faults, np.random.Generator], str]] = {
    "lag": _lag,
    "jitter": _jitter,
    "camera": _camera,
    "gripper": _gripper,
    "mass": _mass,
    "lost frames": _drop_images,
    "frozen frames": _freeze_images,
}


def draw_faults(seed: int, rng: np.random.Generator) -> tuple[Faults, dict[str, str]]:
    """Return the grip and one to three further faults; benches in a row have every further fault equally often."""
    faults = Faults()
    sizes = {"grip": _hinge_or_clamp(faults, rng)}
    names = list(FURTHER_FAULTS)
    order = np.random.default_rng([seed // len(names), 77]).permutation(len(names))
    for k in range(1 + seed // len(HOLDINGS) % 3):
        name = names[order[(seed + 2 * k) % len(names)]]  # the stride is coprime to the number of faults
        sizes[name] = FURTHER_FAULTS[name](faults, rng)
    return faults, sizes


# -- a bench ----------------------------------------------------------------------------------------------------------


def holding_of_seed(seed: int) -> str:
    """Return how the cloth of a seed is held."""
    return HOLDINGS[seed % len(HOLDINGS)]


def camera_of_seed(seed: int) -> str:
    """Return the camera of a seed; 24 benches in a row have every holding, motion and camera together once."""
    return CAMERAS[(seed + seed // 12) % len(CAMERAS)]


def motion_of_seed(seed: int) -> str:
    """Return the name of the motion of a seed."""
    return list(MOTIONS)[seed % len(MOTIONS)]


class BenchDraw(NamedTuple):
    """What is drawn before a bench is simulated.

    Attributes:
        holding: one of ``HOLDINGS``.
        camera: one of ``CAMERAS``.
        faults: what is off.
        fault_sizes: each with its size and unit.
        scene: the sheet, its bending and the air.
    """

    holding: str
    camera: str
    faults: Faults
    fault_sizes: dict[str, str]
    scene: Scene


def draw_bench(seed: int, rng: np.random.Generator, spacing: float) -> BenchDraw:
    """Draw the bench of a seed; ``rng`` draws the sheet, whose vertices are ``spacing`` [m] apart."""
    holding = holding_of_seed(seed)
    faults, sizes = draw_faults(seed, np.random.default_rng([seed, 77, 2]))
    return BenchDraw(
        holding, camera_of_seed(seed), faults, sizes, _draw_scene(rng, holding, faults.held_depth, spacing)
    )


def draw_towel(seed: int, rng: np.random.Generator, spacing: float) -> BenchDraw:
    """Return a newcomer's towel: on a bar as on a hinge, before a stereo camera, and nothing else is off."""
    del seed, rng  # they draw the motion, the noise and the first shape
    sheet = SheetSpec(
        TOWEL_WIDTH_M,
        TOWEL_HEIGHT_M,
        nodes=(round(TOWEL_WIDTH_M / spacing) + 1, round(TOWEL_HEIGHT_M / spacing) + 1),
        areal_density=0.3,
        membrane_stiffness=800.0,
        poisson_ratio=0.3,
        damping_time=2e-4,
    )
    scene = Scene(sheet, PlateSpec(stiffness=1e-4, damping_time=0.015), air=AirSpec(normal=1.3))
    return BenchDraw("bar", "realsense", Faults(), {"grip": "hinge"}, scene)


def make_bench(
    seed: int,
    size: BenchSize | None = None,
    draw: Callable[[int, np.random.Generator, float], BenchDraw] = draw_bench,
) -> StrangerBench:
    """Simulate a bench.

    Args:
        seed: of everything.
        size: of meshes and images; None: the usual one.
        draw: draws what is simulated.

    Raises:
        InvalidInput: no motion of the seed is within the arms' reach.
    """
    size = size or BenchSize()
    scene_rng, motion_rng, _, time_rng = (np.random.default_rng([seed, 77, k]) for k in range(4))
    motion = motion_of_seed(seed)
    holding, camera, faults, fault_sizes, scene = draw(seed, scene_rng, size.spacing)
    rig = _make_rig(holding)
    t, poses, joints = _draw_reachable_path(motion_rng, rig, holding, motion, scene.sheet)
    origin = np.zeros(3)
    paths = {name: move_origin(pose, faults.gripper_shift.get(name, origin)) for name, pose in poses.items()}
    result = _simulate(scene_rng, scene, holding, faults.held_depth, t, paths)
    light_times, stamps = _draw_stamps(time_rng, float(t[-1]), size.rate, faults)
    x = CubicSpline(result.t, result.x)(light_times)
    margin = np.arange(1, round(ROBOT_LOG_MARGIN_S / KNOT_PERIOD_S) + 1) * KNOT_PERIOD_S
    repeats = (len(margin), len(margin))
    return StrangerBench(
        seed,
        holding,
        camera,
        motion,
        fault_sizes,
        true_parameters(scene),
        scene.sheet,
        faults.mass * scene.sheet.areal_density * scene.sheet.width * scene.sheet.height,
        _list_grasped_places(holding, scene.sheet),
        rig,
        np.concatenate([t[0] - margin[::-1], t, t[-1] + margin]),
        {name: np.pad(q, (repeats, (0, 0)), mode="edge") for name, q in joints.items()},
        {name: sample_poses(t, pose, light_times) for name, pose in paths.items()},
        light_times,
        stamps,
        x,
        _displace_camera(faults, x),
        size,
    )


def _draw_scene(rng: np.random.Generator, holding: str, held_depth: float, spacing: float) -> Scene:
    def draw(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    is_corner = holding == "corner"
    longer = rng.uniform(*(CORNER_SIDE_RANGE_M if is_corner else SIDE_RANGE_M))
    shorter = longer * rng.uniform(*(CORNER_ASPECT_RANGE if is_corner else ASPECT_RANGE))
    # whole millimetres, as a ruler shows them
    width, height = (round(float(side), 3) for side in rng.permutation([longer, shorter]))
    lines_u = _grid_lines(width, held_depth if holding == "corners" else 0.0, held_depth * (holding != "bar"), spacing)
    lines_v = _grid_lines(height, 0.0, held_depth, spacing)
    sheet = SheetSpec(
        width,
        height,
        nodes=(len(lines_u), len(lines_v)),
        lines_u=lines_u,
        lines_v=lines_v,
        areal_density=draw(*AREAL_DENSITY_RANGE),
        membrane_stiffness=draw(*MEMBRANE_STIFFNESS_RANGE),
        poisson_ratio=rng.uniform(*POISSON_RANGE),
        damping_time=2e-4,
    )
    plate = PlateSpec(stiffness=draw(*BENDING_STIFFNESS_RANGE), damping_time=rng.uniform(0.01, 0.02))
    return Scene(sheet, plate, air=AirSpec(normal=rng.uniform(*DRAG_RANGE)))


def _grid_lines(length: float, held_low: float, held_high: float, spacing: float) -> tuple[float, ...]:
    """Return places of vertices from 0 to a length, with one at the end of what is held at either side."""
    ends = np.unique([0.0, held_low, length - held_high, length])
    parts = [np.linspace(a, b, max(1, round((b - a) / spacing)) + 1)[:-1] for a, b in pairwise(ends)]
    return (*map(float, np.concatenate(parts)), length)


def _list_grasped_places(holding: str, sheet: SheetSpec) -> dict[str, Array]:
    if holding == "bar":
        return {ONE_ARM_NAME: np.array([sheet.width / 2, sheet.height])}
    if holding == "corner":
        return {ONE_ARM_NAME: np.array([sheet.width, sheet.height])}
    return {name: np.array([0.0 if side > 0 else sheet.width, sheet.height]) for name, side in ARM_SIDES.items()}


def _make_rig(holding: str) -> Rig:
    if holding == "corners":
        return bimanual_rig(model=ARM_MODEL, frame=ARM_TOOL)
    return Rig({ONE_ARM_NAME: load(ARM_MODEL, frame=ARM_TOOL)}, Table())


# -- the motion -------------------------------------------------------------------------------------------------------


def _draw_reachable_path(
    rng: np.random.Generator, rig: Rig, holding: str, motion: str, sheet: SheetSpec
) -> tuple[Array, dict[str, Array], dict[str, Array]]:
    """Return times [K] s, poses [K, 4, 4] m of what is held and joints [K, J] rad, by gripper."""
    for _ in range(IK_ATTEMPTS):
        t, poses = _draw_path(rng, holding, motion, sheet)
        try:
            joints = {name: _solve_joints(rig, name, pose) for name, pose in poses.items()}
            measure_joint_usage(rig, t, joints)
        except InvalidInput:
            continue
        return t, poses, joints
    raise InvalidInput("a motion within the arms' reach", got=f"none in {IK_ATTEMPTS} draws", remedy="another seed")


def _draw_path(rng: np.random.Generator, holding: str, motion: str, sheet: SheetSpec) -> tuple[Array, dict[str, Array]]:
    waypoints, speed = HANGING_MOTIONS[motion], rng.uniform(*MOTIONS[motion])
    heading = rng.uniform(-HEADING_RANGE_RAD, HEADING_RANGE_RAD)
    knots = STANDSTILL_S + np.asarray(waypoints.t) / speed
    t = np.arange(round((knots[-1] + STILL_AFTERWARDS_S) / KNOT_PERIOD_S) + 1) * KNOT_PERIOD_S
    yaw = np.full_like(t, heading)
    if waypoints.yaw:
        turned = np.asarray(waypoints.yaw)
        yaw += minimum_jerk(t, knots, MAX_YAW_RAD / np.abs(turned).max() * turned)
    below = np.hypot(sheet.width, sheet.height) if holding == "corner" else sheet.height
    offset = minimum_jerk(t, knots, _tilt_shake(np.asarray(waypoints.offset, float), holding, motion))
    centre = np.array([*TOP_EDGE_M, CLEARANCE_M + below]) + offset @ rotations_about_z(np.array([heading]))[0].T
    turn, poses = rotations_about_z(yaw), {}
    distance = TAUT_DISTANCE_RATIO * sheet.width if holding == "corners" else 0.0
    for name in ARM_SIDES if holding == "corners" else (ONE_ARM_NAME,):
        poses[name] = np.tile(np.eye(4), (len(t), 1, 1))
        poses[name][:, :3, :3] = turn
        poses[name][:, :3, 3] = centre + turn @ np.array([0.0, ARM_SIDES.get(name, 0.0) * distance / 2, 0.0])
    return t, poses


def _tilt_shake(offset: Array, holding: str, motion: str) -> Array:
    """Return waypoints [N, 3] m: a shake goes forwards as far as upwards, unless the sheet hangs from one corner.

    A sheet that hangs in its plane moves along with a vertical shake as a board does, within 0.1 mm.
    """
    if motion != "shake" or holding == "corner":
        return offset
    return Rotation.from_rotvec([0.0, SHAKE_TILT_RAD, 0.0]).apply(offset)


def _solve_joints(rig: Rig, name: str, pose: Array) -> Array:
    """Return joints [K, J] rad at which the tool holds the cloth from above: one arm from straight above."""
    side = ARM_SIDES.get(name)
    rotation = Swing(tilt=0.0).tool_rotation(1.0) if side is None else Swing().tool_rotation(side)
    pose_of_tool = torch.as_tensor(hold_from_above(pose, rotation))
    return rig[name].inverse(pose_of_tool, rig[name].home, tolerance=IK_TOLERANCE_M).numpy()


# -- the cloth --------------------------------------------------------------------------------------------------------


def _simulate(
    rng: np.random.Generator, scene: Scene, holding: str, held_depth: float, t: Array, poses: Mapping[str, Array]
) -> Result:
    """Let the sheet settle, then move it."""
    uv, _ = sheet_mesh(scene.sheet)
    first = [pose[0] for pose in poses.values()]
    middle, turn = np.mean([pose[:3, 3] for pose in first], axis=0), first[0][:3, :3]
    x0 = middle + _hang(rng, scene.sheet, holding, uv) @ turn.T
    grips = {}
    for name, place in _list_grasped_places(holding, scene.sheet).items():
        below = np.abs(uv - place)
        if holding == "bar":
            below[:, 0] = 0.0
        grips[name] = Grip(np.flatnonzero(below.max(1) <= held_depth + 1e-9), t, poses[name])
    return settle_and_move(scene, x0, grips, t)


def _hang(rng: np.random.Generator, sheet: SheetSpec, holding: str, uv: Array) -> Array:
    """Return a flat shape [V, 3] m about the middle of what is held, at heading 0, from which the sheet settles."""
    width, height = sheet.width, sheet.height
    if holding == "corner":
        corner, diagonal = np.array([width, height]), np.hypot(width, height)
        up = corner / diagonal
        below, across = (uv - corner) @ up, (uv - corner) @ np.array([-up[1], up[0]])
        phase = rng.uniform(-np.pi, np.pi)
        folded = CORNER_FOLD_M * np.sin(3 * np.pi * across / diagonal + phase) * below / diagonal
        return np.stack([folded, across, below], 1)
    a, b = uv[:, 0] / width, uv[:, 1] / height
    sizes = BULGE_STD_M * rng.standard_normal(3)
    bulge = sum(size * np.sin(np.pi * (k + 1) * a) for k, size in enumerate(sizes)) * (1 - b)
    ratio = TAUT_DISTANCE_RATIO if holding == "corners" else 1.0
    return np.stack([bulge, ratio * width * (0.5 - a), uv[:, 1] - height], 1)


# -- what the camera says ---------------------------------------------------------------------------------------------


def _draw_stamps(rng: np.random.Generator, end: float, rate: float, faults: Faults) -> tuple[Array, Array]:
    """Return when the light of each image came [T] s, and what its stamp says [T] s."""
    light = np.arange(int(end * rate) + 1) / rate
    count = len(light)
    stamps = jitter_stamps(light, faults.jitter, rng) if faults.jitter else light.copy()
    frozen, gap = (int(first) for first in rng.integers(count // 4, count - GAP_FRAMES - 2, 2))
    source = np.arange(count)
    if faults.is_frozen:
        source[frozen : frozen + GAP_FRAMES] = frozen
    remains = np.ones(count, bool)
    if faults.has_gaps:
        remains = rng.random(count) >= DROPPED_FRACTION
        remains[gap : gap + GAP_FRAMES] = False
        remains[0] = True
    return light[source][remains], stamps[remains] + faults.lag


def _displace_camera(faults: Faults, x: Array) -> Array:
    """Return the rigid motion [4, 4] m from what is to what the stated camera sees."""
    middle = (x.min((0, 1)) + x.max((0, 1))) / 2
    out = np.eye(4)
    out[:3, :3] = Rotation.from_rotvec(faults.camera_rotation).as_matrix()
    out[:3, 3] = middle + faults.camera_shift - out[:3, :3] @ middle
    return out
