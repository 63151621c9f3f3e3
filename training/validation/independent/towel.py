"""A newcomer's towel: held by a bar or by one corner as by a hinge, seen by a stereo camera.

The towel turns freely about what holds it. The recording says that a patch is held, as a clamp holds it. The depth
has noise along the ray and a larger slow error. The first shape lies at the depths of the first frame, and no noise is
stated. The nominal stiffnesses are off by ``NOMINAL_ERROR_FACTOR``.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial import KDTree

from torchcloth.recordings import GraspInfo, PointClouds

from .air import AirSpec
from .flex_sheet import SheetSpec, interpolate_bilinear, sheet_mesh
from .generate import make_recording
from .motions import CLEARANCE_M, KNOT_PERIOD_S, PIVOT_M, STANDSTILL_S, Motion, minimum_jerk
from .mujoco_cloth import Grip, Result
from .plate import PlateSpec
from .rig_recording import RigRecording, true_parameters, without_extras
from .scene import GripSpec, Scene, settle_and_move
from .sensor import SensorSpec, depth_error_modes

Array = np.ndarray
TOWEL_CASES = ("bar", "corner")
WIDTH_M, HEIGHT_M = 0.4, 0.3
TRUTH_NODES, FIT_NODES = (25, 19), 13  # along u and v; along each side
STATED_RADIUS_M = 0.036  # two rows of the recording's mesh, of which one is held
NOMINAL_ERROR_FACTOR = 2.5
STEREO_NOISE_STD_M, DEPTH_BIAS_STD_M = 3e-3, 5.8e-3  # 6.5 mm in all
SWING_AMPLITUDE_M, SWING_LEG_S = 0.06, 0.45
MAX_BULGE_M = 5e-3  # of the flat towel, which a corner cannot hold
CUT_SHORT_ITERATIONS = 4  # of the towel that hangs from a corner
SURFACE_NODES = 121  # along each side of the dense surface on which true depths are looked up


def make_towel_recording(case: str, seed: int = 0, nodes: tuple[int, int] = TRUTH_NODES) -> RigRecording:
    """Simulate a towel and return its recording.

    Args:
        case: one of ``TOWEL_CASES``.
        seed: of all noise.
        nodes: vertices of the simulated towel along its width and height.
    """
    sheet = SheetSpec(
        WIDTH_M,
        HEIGHT_M,
        nodes=nodes,
        areal_density=0.3,
        membrane_stiffness=800.0,
        poisson_ratio=0.3,
        damping_time=1e-4,
    )
    scene = Scene(
        sheet,
        PlateSpec(stiffness=1e-4, damping_time=0.015),
        air=AirSpec(normal=1.3),
        grip=GripSpec(STATED_RADIUS_M),
        sensor=SensorSpec(noise=STEREO_NOISE_STD_M, bias=DEPTH_BIAS_STD_M, occlusion=0.05),
    )
    nominal = replace(
        scene,
        sheet=replace(sheet, membrane_stiffness=sheet.membrane_stiffness / NOMINAL_ERROR_FACTOR),
        plate=replace(scene.plate, stiffness=NOMINAL_ERROR_FACTOR * scene.plate.stiffness),
    )
    motion = _make_motion(case, sheet)
    result = _simulate(case, scene, motion)
    recording = without_extras(make_recording(scene, motion, result, case, seed, FIT_NODES, data_sheet_scene=nominal))
    uv, clouds = np.asarray(recording.cloth.uv), recording.require("points")
    stated = uv[uv[:, 1] > HEIGHT_M - 1e-9] if case == "bar" else uv[[-1]]
    first = _first_shape_from_depth(scene, result.x[0], clouds, uv)
    recording = replace(
        recording,
        cloth=replace(recording.cloth, initial_vertices=first),
        grasps={case: GraspInfo(stated, STATED_RADIUS_M)},
    )
    error = first - interpolate_bilinear(sheet, result.x[0], uv)[0]
    frames = CubicSpline(motion.t, result.x)(clouds.t)
    return RigRecording(
        recording,
        "swing",
        {"grip": "hinge", "first shape": f"{1e3 * np.sqrt((error**2).sum(-1).mean()):.1f} mm"},
        true_parameters(scene),
        float(np.hypot(STEREO_NOISE_STD_M, DEPTH_BIAS_STD_M)),
        np.stack([interpolate_bilinear(sheet, x, uv)[0] for x in frames]),
        CUT_SHORT_ITERATIONS if case == "corner" else None,
    )


def _make_motion(case: str, sheet: SheetSpec) -> Motion:
    """Return a swing along x of the bar at the upper edge, or of the last corner."""
    knots = STANDSTILL_S + SWING_LEG_S * np.array([0.0, 0.6, 1.6, 2.6, 3.2])
    offset = SWING_AMPLITUDE_M * np.array([0.0, 1.0, -1.0, 1.0, 0.0])
    t = np.arange(round((knots[-1] + STANDSTILL_S) / KNOT_PERIOD_S) + 1) * KNOT_PERIOD_S
    top = np.hypot(sheet.width, sheet.height) if case == "corner" else sheet.height
    place = PIVOT_M + np.array([0.0, 0.0, CLEARANCE_M + top])
    pose = np.tile(np.eye(4), (len(t), 1, 1))
    pose[:, :3, 3] = place + minimum_jerk(t, knots, offset)[:, None] * np.array([1.0, 0.0, 0.0])
    point = np.array([sheet.width / 2 if case == "bar" else sheet.width, sheet.height])
    below = np.array([0.0, 1.0]) if case == "bar" else point / np.linalg.norm(point)  # in the pattern, upwards

    def initial_shape(uv: Array) -> Array:
        up = (uv - point) @ below
        aside = (uv - point) @ np.array([-below[1], below[0]])
        bulge = MAX_BULGE_M * np.sin(4 * np.pi * aside / sheet.width) * up / top  # a plane is a bifurcation
        return place + np.stack([bulge, aside, up], 1)

    return Motion(t, {case: pose}, {case: point}, initial_shape)


def _simulate(case: str, scene: Scene, motion: Motion) -> Result:
    """Let the towel settle, then move it; the outermost row of vertices is held, or the one at the corner."""
    uv, _ = sheet_mesh(scene.sheet)
    vertices = np.flatnonzero(uv[:, 1] > HEIGHT_M - 1e-9) if case == "bar" else np.array([len(uv) - 1])
    grips = {case: Grip(vertices, motion.t, motion.pose[case])}
    return settle_and_move(scene, motion.initial_shape(uv), grips, motion.t)


def _first_shape_from_depth(scene: Scene, x: Array, clouds: PointClouds, uv: Array) -> Array:
    """Return the vertices [V, 3] m on their true rays, at depths with the slow error of the first cloud.

    A smooth surface through the first cloud averages the noise of single points, and follows the error they share.
    """
    across, up = np.meshgrid(np.linspace(0, WIDTH_M, SURFACE_NODES), np.linspace(0, HEIGHT_M, SURFACE_NODES))
    dense = interpolate_bilinear(scene.sheet, x, np.stack([across.ravel(), up.ravel()], 1))[0]
    points, vertices = clouds.frame(0), interpolate_bilinear(scene.sheet, x, uv)[0]
    true_ray, true_depth = _split_rays(scene.sensor, dense)
    ray, depth = _split_rays(scene.sensor, points)
    error = depth - true_depth[KDTree(true_ray).query(ray)[1]]
    coefficients = np.linalg.lstsq(depth_error_modes(scene.sensor, points).T, error, rcond=None)[0]
    ray, depth = _split_rays(scene.sensor, vertices)
    depth = depth + coefficients @ depth_error_modes(scene.sensor, vertices)
    return scene.sensor.position + ray * depth[:, None]


def _split_rays(sensor: SensorSpec, points: Array) -> tuple[Array, Array]:
    """Return the unit vectors [N, 3] from the camera to points [N, 3] m, and their distances [N] m."""
    ray = points - sensor.position
    depth = np.linalg.norm(ray, axis=1)
    return ray / depth[:, None], depth
