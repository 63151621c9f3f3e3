"""Draw and write recordings as a stranger has them: one motion, no stated noise, and one to three faults of a rig.

The cloth is MuJoCo's. A recording is a function of its seed alone. Every rig has what every rig has: noise along
the ray, a slow bias of the depth, grippers that are 1 mm beside where they say, a first shape that is 1 mm off, and a
nominal fabric that is off. The faults come on top.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline

from torchcloth._utils.constants import STANDARD_AIR_DENSITY_KG_PER_M3
from torchcloth.recordings import PointClouds, Recording

from .air import AirSpec
from .flex_sheet import SheetSpec, interpolate_bilinear
from .generate import make_recording
from .motions import make_motion
from .plate import PlateSpec
from .scene import GripSpec, Scene, simulate
from .sensor import SensorSpec

Array = np.ndarray
SHEET_SIDE_M = 0.30
MOTIONS = {"swing-fast": (0.9, 1.2), "shake": (0.8, 1.1), "swing": (1.4, 1.8), "turn": (1.5, 1.9)}  # range of speed
# Ranges of the true fabric, drawn evenly in the logarithm: knits that any mesh of this size can resolve.
MEMBRANE_STIFFNESS_RANGE = (80.0, 300.0)  # N/m
BENDING_STIFFNESS_RANGE = (3e-5, 1.5e-4)  # N m
AREAL_DENSITY_RANGE = (0.18, 0.32)  # kg/m^2
DRAG_RANGE, POISSON_RANGE = (0.8, 1.6), (0.2, 0.4)
NOMINAL_LOG_STD = 0.4  # of the nominal stiffnesses about the true ones
NOMINAL_POISSON_RATIO = 0.3
POINT_NOISE_STD_M = 2e-3  # along the ray
BIAS_RANGE_M = (0.5e-3, 1.5e-3)  # standard deviation of the slow error of the depth
OCCLUSION_RANGE = (0.05, 0.15)
GRIP_POSITION_STD_M = 1e-3
GRIP_RADIUS_M = 0.026
MAX_LAG_S, MAX_JITTER_STD_S = 0.06, 0.04
CLAMP_EXTRA_RADIUS_M, HINGE_RADIUS_M = 0.012, 1e-3
FIRST_SHAPE_ERROR_RANGE_M, SHAPE_ERROR_NODES = (2e-3, 6e-3), 4
DENSITY_ERROR, CAMERA_SHIFT_M, START_ERROR_FACTOR = 0.1, 5e-3, 10.0
GAP_FRAMES, DROPPED_FRACTION = 5, 0.2
FINGER_POINTS, FINGER_SIZE_M, FINGER_HEIGHT_M = 25, (0.03, 0.03, 0.08), 0.05  # its middle above the grasp point
CUT_SHORT_ITERATIONS = 4
MIN_STAMP_STEP_S = 1e-4


@dataclass(frozen=True)
class MeshSize:
    """Vertices along each side of the sheets.

    Attributes:
        truth: of the simulated sheet.
        fit: of the mesh in the recording.
        coarse: of the mesh in the recording, where that is the fault (7: 72 triangles).
    """

    truth: int = 21
    fit: int = 13
    coarse: int = 7


@dataclass
class Rig:
    """One rig while it is drawn; faults change it.

    Attributes:
        scene: the true scene.
        nominal: what the data sheet says.
        nodes: vertices along each side of the recording's mesh.
        lag: by which stamps are late [s].
        jitter: standard deviation of each stamp [s].
        first_shape_error: root mean square [m].
        has_gaps, frozen, has_robot_points: faults of the clouds.
        iterations: after which the search is cut short; None: it is not.
    """

    scene: Scene
    nominal: Scene
    nodes: int
    lag: float = 0.0
    jitter: float = 0.0
    first_shape_error: float = 0.0
    has_gaps: bool = False
    frozen: bool = False
    has_robot_points: bool = False
    iterations: int | None = None


@dataclass(frozen=True)
class RigRecording:
    """A recording, and what is hidden in it.

    Attributes:
        recording: without a stated noise.
        motion: its name.
        faults: each with its size and unit.
        truth: true values by the name of the fitted parameter.
        noise_std: true standard deviation of a point along the ray, slow bias included [m].
        vertices: [T, V, 3] m, where the recording's vertices were when the light of each cloud came, as a camera at its
            stated place sees them.
        iterations: after which the search is cut short; None: it is not.
    """

    recording: Recording
    motion: str
    faults: dict[str, str]
    truth: dict[str, float]
    noise_std: float
    vertices: Array
    iterations: int | None


# -- faults -----------------------------------------------------------------------------------------------------------


def _lag(rig: Rig, rng: np.random.Generator, size: MeshSize) -> str:
    rig.lag = rng.uniform(0, MAX_LAG_S)
    return f"{1e3 * rig.lag:.0f} ms"


def _jitter(rig: Rig, rng: np.random.Generator, size: MeshSize) -> str:
    rig.jitter = rng.uniform(0, MAX_JITTER_STD_S)
    return f"{1e3 * rig.jitter:.0f} ms"


def _grip(rig: Rig, rng: np.random.Generator, size: MeshSize) -> str:
    is_hinge = rng.random() < 0.5
    grip = GripSpec(radius=HINGE_RADIUS_M) if is_hinge else GripSpec(GRIP_RADIUS_M, extra_radius=CLAMP_EXTRA_RADIUS_M)
    rig.scene = replace(rig.scene, grip=grip)
    return "hinge" if is_hinge else f"clamp, {1e3 * CLAMP_EXTRA_RADIUS_M:.0f} mm wider"


def _first_shape(rig: Rig, rng: np.random.Generator, size: MeshSize) -> str:
    rig.first_shape_error = rng.uniform(*FIRST_SHAPE_ERROR_RANGE_M)
    return f"{1e3 * rig.first_shape_error:.1f} mm"


def _density(rig: Rig, rng: np.random.Generator, size: MeshSize) -> str:
    error = rng.choice([-DENSITY_ERROR, DENSITY_ERROR])
    sheet = rig.nominal.sheet
    rig.nominal = replace(rig.nominal, sheet=replace(sheet, areal_density=(1 + error) * sheet.areal_density))
    return f"{100 * error:+.0f} %"


def _camera(rig: Rig, rng: np.random.Generator, size: MeshSize) -> str:
    heading = rng.uniform(0, 360)
    sensor = replace(rig.scene.sensor, shift=CAMERA_SHIFT_M, heading=heading)
    rig.scene = replace(rig.scene, sensor=sensor)
    return f"{1e3 * CAMERA_SHIFT_M:.0f} mm"


def _drop_frames(rig: Rig, rng: np.random.Generator, size: MeshSize) -> str:
    rig.has_gaps = True
    return f"{GAP_FRAMES} in a row and {100 * DROPPED_FRACTION:.0f} %"


def _frozen(rig: Rig, rng: np.random.Generator, size: MeshSize) -> str:
    rig.frozen = True
    return f"{GAP_FRAMES} in a row"


def _robot_points(rig: Rig, rng: np.random.Generator, size: MeshSize) -> str:
    rig.has_robot_points = True
    return f"{FINGER_POINTS} of each finger"


def _coarse(rig: Rig, rng: np.random.Generator, size: MeshSize) -> str:
    rig.nodes = size.coarse
    return f"{2 * (size.coarse - 1) ** 2} triangles"


def _start(rig: Rig, rng: np.random.Generator, size: MeshSize) -> str:
    factor = START_ERROR_FACTOR ** rng.choice([-1, 1])
    sheet = rig.nominal.sheet
    stiffness = factor * rig.scene.sheet.membrane_stiffness
    rig.nominal = replace(rig.nominal, sheet=replace(sheet, membrane_stiffness=stiffness))
    return f"{factor:g} times"


def _cut_short(rig: Rig, rng: np.random.Generator, size: MeshSize) -> str:
    rig.iterations = CUT_SHORT_ITERATIONS
    return f"{CUT_SHORT_ITERATIONS} iterations"


FAULTS: dict[str, Callable[[Rig, np.random.Generator, MeshSize], str]] = {
    "lag": _lag,
    "jitter": _jitter,
    "grip": _grip,
    "first shape": _first_shape,
    "density": _density,
    "camera": _camera,
    "lost frames": _drop_frames,
    "frozen frames": _frozen,
    "robot points": _robot_points,
    "coarse mesh": _coarse,
    "start": _start,
    "cut short": _cut_short,
}


def draw_faults(seed: int) -> list[str]:
    """Return one to three faults of a rig. Rigs in a row have every fault equally often.

    Each dozen of seeds goes through a random order of the faults; rig ``k`` begins at its place ``k``.
    """
    names = list(FAULTS)
    order = np.random.default_rng([seed // len(names), 7]).permutation(len(names))
    count = 1 + seed % 3
    # strides of 1 and 5 are coprime to the dozen: pairs differ from rig to rig
    return [names[order[(seed + 5 * k) % len(names)]] for k in range(count)]


# -- a recording ------------------------------------------------------------------------------------------------------


def make_rig_recording(seed: int, size: MeshSize | None = None) -> RigRecording:
    """Simulate a rig and return its recording.

    Args:
        seed: of everything.
        size: of the meshes; None: the usual one.
    """
    size = size or MeshSize()
    rng = np.random.default_rng([seed, 71])
    rig = _draw_rig(rng, size)
    motion_name = list(MOTIONS)[seed % len(MOTIONS)]
    speed, heading = rng.uniform(*MOTIONS[motion_name]), rng.uniform(0, 360)
    faults = {name: FAULTS[name](rig, rng, size) for name in draw_faults(seed)}
    sensor = replace(rig.scene.sensor, delay=rig.lag)
    scene = replace(rig.scene, sensor=sensor)
    motion = make_motion(motion_name, scene.sheet, heading, speed)
    result = simulate(scene, motion)
    recording = make_recording(scene, motion, result, motion_name, seed, rig.nodes, data_sheet_scene=rig.nominal)
    recording = without_extras(_with_first_shape_error(_with_grip_errors(recording, rng), rig, rng))
    clouds = recording.require("points")
    points, shots = _with_cloud_faults(clouds, recording, rig, rng)
    # before the motion the cloth is at rest
    light_times = np.maximum(clouds.t[shots] - rig.lag, motion.t[0])
    frames = CubicSpline(motion.t, result.x)(light_times)
    true_sheet, uv = scene.aligned_to_patches.sheet, np.asarray(recording.cloth.uv)
    angle = np.deg2rad(sensor.heading)
    seen_shift = sensor.shift * np.array([np.cos(angle), np.sin(angle), 0.0])
    vertices = np.stack([interpolate_bilinear(true_sheet, x, uv)[0] for x in frames]) + seen_shift
    noise_std = float(np.hypot(sensor.noise, sensor.bias))
    recording = replace(recording, points=points)
    return RigRecording(recording, motion_name, faults, true_parameters(rig.scene), noise_std, vertices, rig.iterations)


def true_parameters(scene: Scene) -> dict[str, float]:
    """Return the true values of a scene by the name of the fitted parameter."""
    return {
        "membrane_stiffness": scene.sheet.membrane_stiffness,
        "poisson_ratio": scene.sheet.poisson_ratio,
        "bending.stiffness": scene.plate.stiffness,
        "air.normal": scene.air.normal,
    }


def _draw_rig(rng: np.random.Generator, size: MeshSize) -> Rig:
    def draw(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    sheet = SheetSpec(
        SHEET_SIDE_M,
        SHEET_SIDE_M,
        nodes=(size.truth, size.truth),
        areal_density=draw(*AREAL_DENSITY_RANGE),
        membrane_stiffness=draw(*MEMBRANE_STIFFNESS_RANGE),
        poisson_ratio=rng.uniform(*POISSON_RANGE),
        damping_time=2e-4,
    )
    plate = PlateSpec(stiffness=draw(*BENDING_STIFFNESS_RANGE), damping_time=rng.uniform(0.01, 0.02))
    sensor = SensorSpec(
        noise=POINT_NOISE_STD_M, bias=rng.uniform(*BIAS_RANGE_M), occlusion=rng.uniform(*OCCLUSION_RANGE)
    )
    scene = Scene(
        sheet, plate, air=AirSpec(normal=rng.uniform(*DRAG_RANGE)), grip=GripSpec(GRIP_RADIUS_M), sensor=sensor
    )
    off = np.exp(NOMINAL_LOG_STD * rng.standard_normal(2))
    nominal_sheet = replace(
        sheet, membrane_stiffness=off[0] * sheet.membrane_stiffness, poisson_ratio=NOMINAL_POISSON_RATIO
    )
    nominal = replace(
        scene, sheet=nominal_sheet, plate=replace(plate, stiffness=off[1] * plate.stiffness, damping_time=0.015)
    )
    return Rig(scene, nominal, size.fit)


def _with_grip_errors(recording: Recording, rng: np.random.Generator) -> Recording:
    """Let each gripper be a little beside where the robot says it is."""
    grippers = {
        name: replace(motion, position=motion.position + GRIP_POSITION_STD_M * rng.standard_normal(3) / np.sqrt(3))
        for name, motion in recording.grippers.items()
    }
    return replace(recording, grippers=grippers)


def _with_first_shape_error(recording: Recording, rig: Rig, rng: np.random.Generator) -> Recording:
    """Displace the first shape smoothly, everywhere but at the grips."""
    knots = rng.standard_normal((SHAPE_ERROR_NODES**2, 3))
    if not rig.first_shape_error:
        return recording
    cloth, uv = recording.cloth, np.asarray(recording.cloth.uv)
    coarse = SheetSpec(SHEET_SIDE_M, SHEET_SIDE_M, nodes=(SHAPE_ERROR_NODES, SHAPE_ERROR_NODES))
    error = interpolate_bilinear(coarse, knots, uv)[0]
    error *= rig.first_shape_error / np.sqrt((error**2).sum(-1).mean())
    places = np.concatenate([np.asarray(grasp.uv) for grasp in recording.grasps.values()])
    distance = np.linalg.norm(uv[:, None] - places, axis=-1).min(1)
    error *= np.clip((distance - GRIP_RADIUS_M) / GRIP_RADIUS_M, 0, 1)[:, None]
    return replace(recording, cloth=replace(cloth, initial_vertices=cloth.initial_vertices + error))


def without_extras(recording: Recording) -> Recording:
    """Leave out what a stranger does not record (forces, split, noise), and say that there is air."""
    grippers = {name: replace(m, force=None, torque=None) for name, m in recording.grippers.items()}
    return replace(
        recording, grippers=grippers, observation_noise_std=None, split={}, air_density=STANDARD_AIR_DENSITY_KG_PER_M3
    )


def _with_cloud_faults(
    clouds: PointClouds, recording: Recording, rig: Rig, rng: np.random.Generator
) -> tuple[PointClouds, Array]:
    """Return the clouds with their faults, and which of the sensor's shots [T] each one is."""
    if rig.has_robot_points:
        clouds = _add_finger_points(clouds, recording, rng)
    frames = len(clouds)
    frozen, gap = (int(first) for first in rng.integers(frames // 4, frames - GAP_FRAMES - 2, 2))
    source = np.arange(frames)
    if rig.frozen:
        source[frozen : frozen + GAP_FRAMES] = frozen
        shots = np.split(clouds.xyz, np.cumsum(clouds.counts)[:-1])
        clouds = PointClouds(clouds.t, np.concatenate([shots[i] for i in source]), clouds.counts[source])
    if rig.jitter:
        stamps = jitter_stamps(clouds.t, rig.jitter, rng)
        clouds = PointClouds(stamps, clouds.xyz, clouds.counts)
    if rig.has_gaps:
        remains = rng.random(frames) >= DROPPED_FRACTION
        remains[gap : gap + GAP_FRAMES] = False
        remains[0] = True
        clouds, source = clouds.select(remains), source[remains]
    return clouds, source


def jitter_stamps(t: Array, std: float, rng: np.random.Generator) -> Array:
    """Return the stamps [T] s of frames at times t [T] s, each off by ``std`` s.

    A frame is stamped when it comes through. The order of the frames remains.
    """
    late = np.sort(t + std * rng.standard_normal(len(t)))
    steps = np.maximum(np.diff(late), MIN_STAMP_STEP_S)
    return np.maximum(late[0], 0.0) + np.concatenate([[0.0], np.cumsum(steps)])


def _add_finger_points(clouds: PointClouds, recording: Recording, rng: np.random.Generator) -> PointClouds:
    """Add points on boxes above the grasp points to every cloud."""
    shots = []
    for k, t in enumerate(clouds.t):
        parts = [clouds.frame(k)]
        for motion in recording.grippers.values():
            place = np.array([np.interp(t, motion.t, motion.position[:, axis]) for axis in range(3)])
            box = rng.uniform(-0.5, 0.5, (FINGER_POINTS, 3))
            side = rng.integers(0, 3, FINGER_POINTS)  # on the box's surface
            box[np.arange(FINGER_POINTS), side] = rng.choice([-0.5, 0.5], FINGER_POINTS)
            parts.append(place + box * FINGER_SIZE_M + [0.0, 0.0, FINGER_HEIGHT_M])
        shots.append(np.concatenate(parts))
    return PointClouds(clouds.t, np.concatenate(shots), np.array([len(shot) for shot in shots]))
