"""Draw recordings that begin in mid-motion: two arms move a sheet, and a depth camera sees what is not hidden.

The cloth is MuJoCo's. The recording has no first shape, and the cloth moves at its first frame. The camera takes whole
depth images of cloth, arms, table, wall and a passing bar, with its noise and its bias at full resolution. The cloth's
points are cut out of them by ``observe.segment_depth``, which knows the arms' joints and the table and nothing else. A
recording is a function of its seed alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from torchcloth import observe, recordings
from torchcloth._utils.constants import STANDARD_AIR_DENSITY_KG_PER_M3
from torchcloth.errors import InvalidInput
from torchcloth.robots import Scene as Rig  # pyright: ignore[reportMissingImports] - mapped from robots/
from torchcloth.robots import bimanual_rig  # pyright: ignore[reportMissingImports] - mapped from robots/

from .air import AirSpec
from .camera_room import build_room, make_camera_noise, place_camera, shrink_camera
from .flex_sheet import SheetSpec, sheet_mesh
from .motions import KNOT_PERIOD_S, minimum_jerk, rotations_about_z
from .mujoco_cloth import Grip, Result, mujoco_version
from .plate import PlateSpec
from .rig_recording import (
    AREAL_DENSITY_RANGE,
    BENDING_STIFFNESS_RANGE,
    DRAG_RANGE,
    GRIP_POSITION_STD_M,
    MEMBRANE_STIFFNESS_RANGE,
    NOMINAL_LOG_STD,
    NOMINAL_POISSON_RATIO,
    POISSON_RANGE,
    true_parameters,
)
from .scene import GripSpec, Scene, settle_and_move
from .swing_motion import Swing, hold_from_above, measure_joint_usage, move_origin, sample_poses

Array = np.ndarray
Mesh = tuple[Array, Array]
GRIPS = ("corners", "edge", "corners", "corner")  # of the seeds, in turn
MOTIONS = ("swing", "shake", "turn", "wander")
CAMERAS = ("kinect", "realsense")
ARM_SIDES = {"left": 1.0, "right": -1.0}  # sign of y
SIDE_RANGE_M, ASPECT_RANGE = (0.30, 0.50), (0.75, 1.0)
# A square that hangs from a corner looks the same with its sides exchanged: no cloud shows which is which.
CORNER_SIDE_RANGE_M, CORNER_ASPECT_RANGE = (0.36, 0.46), (0.65, 0.78)
GRIP_RADIUS_M = 0.026
EDGE_CLAMP_FRACTION, EDGE_CLAMP_DEPTH_M, EDGE_CLAMP_POINT_SPACING_M = 0.4, 0.015, 0.01  # of the width, for each arm
CLAMP_BAR_SIZE_M, CLAMP_BAR_HEIGHT_M = (0.02, 0.03), 0.01  # thickness and height; its middle above the edge
DISTANCE_RATIO_RANGE = (0.97, 1.006)  # of the grippers, over the distance of what they hold
TOP_EDGE_M = (0.50, 0.0)  # x and y of the middle of the grippers at rest
TABLE_CLEARANCE_M = 0.06  # of the lowest point of a hanging sheet above the table
HEADING_RANGE_RAD, CORNER_OFFSET_M = 0.35, 0.10  # the one arm's corner lies to its side
MOTION_S = 2.4
START_RANGE_S, DURATION_RANGE_S = (0.5, 0.8), (1.0, 1.5)  # of the recording, in the motion
CAMERA_RATE_HZ = 30.0
PARKED_TURN_RAD = 1.0  # of the first joint of an arm that holds nothing
IK_ATTEMPTS = 20
AZIMUTH_RANGE_RAD = 0.9
BAR_WIDTH_RANGE = (0.15, 0.30)  # over the width of the cloth in the image
BAR_PLACE_FRACTION, BAR_LENGTH_M, BAR_TILT_STD_RAD = 0.6, 1.5, 0.2  # place: of the way from the cloth to the camera
MAX_POINTS = 250
# The rig's margins for the bias of the sensor, which moves the arms' points too.
ROBOT_MARGIN_M, SEGMENTED_TABLE_MARGIN_M = {"kinect": 0.02, "realsense": 0.03}, 0.02
WORKSPACE_MARGIN_M = 0.05
PIXEL_STRIDE = 2  # every other row and column is segmented: a cloud has thousands of points more than it needs
ISOLATION_RADIUS_M, ISOLATION_NEIGHBOURS = 0.02, 8
GRASP_DISTANCE_FRACTION = 0.4  # of the sheet's diagonal; a bar leaves cloth in pieces, and is farther from the grippers


@dataclass(frozen=True)
class MovingSize:
    """Sizes of a recording.

    Attributes:
        spacing: of the simulated vertices [m].
        fit: vertices along each side of the mesh in the recording.
        rate: of the frames [Hz].
        shrink: factor by which the camera's images are smaller, 1 or 2.
    """

    spacing: float = 0.02
    fit: int = 13
    rate: float = CAMERA_RATE_HZ
    shrink: int = 1


@dataclass(frozen=True)
class MovingRecording:
    """A recording that begins in mid-motion, and what is hidden in it.

    Attributes:
        recording: without a first shape and without a stated noise.
        grip: one of ``GRIPS``.
        motion: one of ``MOTIONS``.
        camera: one of ``CAMERAS``.
        truth: true values by the name of the fitted parameter.
        uv: [V, 2] m, pattern places of the true vertices below.
        vertices: [T, V, 3] m, at the frames.
        velocities: [T, V, 3] m/s.
        occluded: share of the cloth's pixels that arms and bar hide, mean over the frames.
        removed: points of the cloth over its visible pixels, mean over the frames: what segmentation leaves.
        foreign: share of the points that are not the cloth's; 0 without any.
    """

    recording: recordings.Recording
    grip: str
    motion: str
    camera: str
    truth: dict[str, float]
    uv: Array
    vertices: Array
    velocities: Array
    occluded: float
    removed: float
    foreign: float


class _Path(NamedTuple):
    """Where the grippers go.

    Attributes:
        t: [K] s.
        pose: [K, 4, 4] m by gripper; y along the held edge.
    """

    t: Array
    pose: dict[str, Array]


class _Hold(NamedTuple):
    """How the sheet hangs.

    Attributes:
        points: [G, 2] m by gripper, pattern places that it holds.
        radius: m, about these.
        distance: m, of the grippers.
        place: maps pattern places [V, 2] m to positions [V, 3] m about the middle of the grippers, at heading 0.
        height: m, from the lowest point to the grippers.
    """

    points: dict[str, Array]
    radius: float
    distance: float
    place: object
    height: float


def grip_of_seed(seed: int) -> str:
    """Return how the cloth of a seed is held."""
    return GRIPS[seed % len(GRIPS)]


def camera_of_seed(seed: int) -> str:
    """Return the camera of a seed. Each grip has each camera equally often."""
    return CAMERAS[(seed + seed // len(GRIPS)) % len(CAMERAS)]


def make_moving_recording(seed: int, size: MovingSize | None = None) -> MovingRecording:
    """Simulate and observe a motion.

    Args:
        seed: of everything.
        size: of meshes and images; None: the usual one.

    Raises:
        InvalidInput: no motion of the seed is within the arms' reach.
    """
    size = size or MovingSize()
    scene_rng, motion_rng, camera_rng, robot_rng = (np.random.default_rng([seed, 72, k]) for k in range(4))
    grip, camera_name = grip_of_seed(seed), camera_of_seed(seed)
    scene = _draw_scene(scene_rng, grip, size.spacing)
    hold = _draw_hold(scene_rng, grip, scene.sheet)
    start, duration = motion_rng.uniform(*START_RANGE_S), motion_rng.uniform(*DURATION_RANGE_S)
    times = start + np.arange(int(duration * size.rate) + 1) / size.rate
    rig = bimanual_rig(model="rizon4", frame="tcp_closed")
    motion, path, joints = _draw_reachable_path(motion_rng, rig, hold, times)
    result, middles = _simulate(scene, hold, path)
    at_grips = {name: move_origin(pose, middles[name]) for name, pose in path.pose.items()}
    seen_poses = {name: sample_poses(path.t, pose, times) for name, pose in at_grips.items()}
    x, v = (CubicSpline(result.t, frames)(times) for frames in (result.x, result.v))
    arms = _arm_meshes(rig, joints, hold, seen_poses)
    observed = _observe(camera_rng, camera_name, scene.sheet, x, arms, seen_poses, rig, size)
    seen = observed.counts > 0
    uv, faces = sheet_mesh(SheetSpec(scene.sheet.width, scene.sheet.height, nodes=(size.fit, size.fit)))
    knots = np.arange(round(duration / KNOT_PERIOD_S) + 1) * KNOT_PERIOD_S + start
    recording = recordings.Recording(
        cloth=_cloth_info(scene, robot_rng, uv, faces),
        provenance=f"synthetic: MuJoCo flex {mujoco_version()}, validation.independent.moving_recording, seed {seed}",
        licence="CC0-1.0",
        grasps={name: recordings.GraspInfo(points, hold.radius) for name, points in hold.points.items()},
        grippers={
            name: _report(knots - start, sample_poses(path.t, pose, knots), robot_rng)
            for name, pose in at_grips.items()
        },
        cameras={"cam0": recordings.Camera(**observed.camera.to_calibration())},
        points=recordings.PointClouds(times[seen] - start, np.concatenate(observed.clouds), observed.counts[seen]),
        gravity=np.array([0.0, 0.0, scene.sheet.gravity]),
        air_density=STANDARD_AIR_DENSITY_KG_PER_M3,
        split={"motion": motion, "replicate_of": None},
    )
    return MovingRecording(
        recording,
        grip,
        motion,
        camera_name,
        true_parameters(scene),
        sheet_mesh(scene.sheet)[0],
        x[seen],
        v[seen],
        observed.occluded,
        observed.removed,
        observed.foreign,
    )


# -- cloth and motion -------------------------------------------------------------------------------------------------


def _draw_scene(rng: np.random.Generator, grip: str, spacing: float) -> Scene:
    def draw(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    sides, aspects = (CORNER_SIDE_RANGE_M, CORNER_ASPECT_RANGE) if grip == "corner" else (SIDE_RANGE_M, ASPECT_RANGE)
    longer = rng.uniform(*sides)
    width, height = rng.permutation([longer, longer * rng.uniform(*aspects)])
    sheet = SheetSpec(
        float(width),
        float(height),
        nodes=(round(width / spacing) + 1, round(height / spacing) + 1),
        areal_density=draw(*AREAL_DENSITY_RANGE),
        membrane_stiffness=draw(*MEMBRANE_STIFFNESS_RANGE),
        poisson_ratio=rng.uniform(*POISSON_RANGE),
        damping_time=2e-4,
    )
    plate = PlateSpec(stiffness=draw(*BENDING_STIFFNESS_RANGE), damping_time=rng.uniform(0.01, 0.02))
    return Scene(sheet, plate, air=AirSpec(normal=rng.uniform(*DRAG_RANGE)), grip=GripSpec(GRIP_RADIUS_M))


def _draw_hold(rng: np.random.Generator, grip: str, sheet: SheetSpec) -> _Hold:
    width, height = sheet.width, sheet.height
    bulge_sizes = 2e-3 * rng.standard_normal(3)
    if grip == "corner":
        corner, diagonal = np.array([width, height]), np.hypot(width, height)
        up = corner / diagonal
        aside = np.array([-up[1], up[0]])

        def place_diagonally(uv: Array) -> Array:
            below, across = (uv - corner) @ up, (uv - corner) @ aside
            # a flat sheet does not hang from a corner: its sides fold towards each other
            folded = 0.02 * np.sin(3 * np.pi * across / diagonal + bulge_sizes[0] * 1e3) * below / diagonal
            return np.stack([folded, across, below], 1)

        return _Hold({"left": corner[None]}, GRIP_RADIUS_M, 0.0, place_diagonally, diagonal)

    ratio = rng.uniform(*DISTANCE_RATIO_RANGE) if grip == "corners" else 1.0
    if grip == "corners":
        points = {"left": np.array([[0.0, height]]), "right": np.array([[width, height]])}
        radius = GRIP_RADIUS_M
    else:
        radius = EDGE_CLAMP_DEPTH_M
        along = np.arange(0.0, EDGE_CLAMP_FRACTION * width, EDGE_CLAMP_POINT_SPACING_M)
        points = {
            "left": np.stack([along, np.full_like(along, height)], 1),
            "right": np.stack([width - along, np.full_like(along, height)], 1),
        }

    def place(uv: Array) -> Array:
        a, b = uv[:, 0] / width, uv[:, 1] / height
        bulge = sum(size * np.sin(np.pi * (k + 1) * a) for k, size in enumerate(bulge_sizes)) * (1 - b)
        return np.stack([bulge, ratio * width * (0.5 - a), uv[:, 1] - height], 1)

    return _Hold(points, radius, ratio * width, place, height)


def _draw_reachable_path(
    rng: np.random.Generator, rig: Rig, hold: _Hold, times: Array
) -> tuple[str, _Path, dict[str, Array]]:
    """Return a motion that the arms can carry out: its name, the path, and the joint positions [T, 7] rad at times."""
    for _ in range(IK_ATTEMPTS):
        name = str(rng.choice(MOTIONS))
        path = _draw_path(rng, name, hold)
        turned = {arm: hold_from_above(p, Swing().tool_rotation(ARM_SIDES[arm])) for arm, p in path.pose.items()}
        tools = {arm: sample_poses(path.t, pose, times) for arm, pose in turned.items()}
        try:
            joints = _solve(rig, tools)
            measure_joint_usage(rig, times, joints)
        except InvalidInput:
            continue
        parked = {arm: rig[arm].home.clone() for arm in ARM_SIDES if arm not in joints}
        for arm, q in parked.items():
            q[0] = q[0] + ARM_SIDES[arm] * PARKED_TURN_RAD
        return name, path, joints | {arm: np.tile(q.numpy(), (len(times), 1)) for arm, q in parked.items()}
    raise InvalidInput("a motion within the arms' reach", got=f"none in {IK_ATTEMPTS} draws", remedy="another seed")


def _solve(rig: Rig, tools: Mapping[str, Array]) -> dict[str, Array]:
    return {
        arm: rig[arm].inverse(torch.as_tensor(pose), rig[arm].home, tolerance=1e-6).numpy()
        for arm, pose in tools.items()
    }


def _draw_path(rng: np.random.Generator, name: str, hold: _Hold) -> _Path:
    """Draw minimum-jerk legs that come to rest at each waypoint, about the heading's axes."""
    leg = {"swing": (0.30, 0.55), "shake": (0.18, 0.28), "turn": (0.40, 0.65), "wander": (0.30, 0.60)}[name]
    legs = rng.uniform(*leg, size=int(MOTION_S / leg[0]) + 1)
    knots = np.concatenate([[0.0], np.cumsum(legs)])
    count, sign = len(legs), (-1.0) ** np.arange(len(legs))
    offset, yaw = 0.012 * rng.standard_normal((count, 3)), 0.05 * rng.standard_normal(count)
    if name == "swing":
        offset[:, 0] += sign * rng.uniform(0.03, 0.07)
    elif name == "shake":
        offset[:, 2] += sign * rng.uniform(0.012, 0.025)
    elif name == "turn":
        yaw += sign * rng.uniform(0.25, 0.6)
    else:
        offset += rng.standard_normal((count, 3)) * [0.05, 0.05, 0.025]
        yaw += 0.2 * rng.standard_normal(count)
    offset[:, 2] = np.maximum(offset[:, 2], -TABLE_CLEARANCE_M / 2)
    t = np.arange(round(MOTION_S / KNOT_PERIOD_S) + 1) * KNOT_PERIOD_S
    heading = rng.uniform(-HEADING_RANGE_RAD, HEADING_RANGE_RAD)
    place = np.array([*TOP_EDGE_M, TABLE_CLEARANCE_M + hold.height])
    if len(hold.points) == 1:
        place[1] += CORNER_OFFSET_M
    path = minimum_jerk(t, knots, np.concatenate([np.zeros((1, 3)), offset]))
    turned = minimum_jerk(t, knots, np.concatenate([[0.0], yaw]))
    turn = rotations_about_z(heading + turned)
    centre = place + path @ rotations_about_z(np.array([heading]))[0].T
    pose = {}
    for arm in hold.points:
        pose[arm] = np.tile(np.eye(4), (len(t), 1, 1))
        pose[arm][:, :3, :3] = turn
        side = np.array([0.0, ARM_SIDES[arm] * hold.distance / 2, 0.0])
        pose[arm][:, :3, 3] = centre + turn @ side
    return _Path(t, pose)


def _simulate(scene: Scene, hold: _Hold, path: _Path) -> tuple[Result, dict[str, Array]]:
    """Let the sheet settle, then move it; return the motion, and the middle [3] m of what is held, in each gripper."""
    uv, _ = sheet_mesh(scene.sheet)
    first = path.pose[next(iter(path.pose))][0, :3, :3]
    middle = np.mean([pose[0, :3, 3] for pose in path.pose.values()], axis=0)
    x0 = middle + hold.place(uv) @ first.T  # type: ignore[operator]
    grips, middles = {}, {}
    for name, pose in path.pose.items():
        apart = np.linalg.norm(uv[:, None] - hold.points[name], axis=-1).min(1)
        vertices = np.flatnonzero(apart <= hold.radius + 1e-9)
        grips[name] = Grip(vertices, path.t, pose)
        at = middle + hold.place(hold.points[name].mean(0, keepdims=True)) @ first.T  # type: ignore[operator]
        middles[name] = (at[0] - pose[0, :3, 3]) @ pose[0, :3, :3]
    return settle_and_move(scene, x0, grips, path.t), middles


# -- what is recorded -------------------------------------------------------------------------------------------------


def _cloth_info(scene: Scene, rng: np.random.Generator, uv: Array, faces: Array) -> recordings.ClothInfo:
    """Return the cloth as its data sheet describes it: both stiffnesses are off."""
    off = np.exp(NOMINAL_LOG_STD * rng.standard_normal(2))
    return recordings.ClothInfo(
        areal_density=scene.sheet.areal_density,
        areal_density_std=0.02 * scene.sheet.areal_density,
        thickness=1e-3,
        vertices=np.column_stack([uv, np.zeros(len(uv))]),
        faces=faces,
        uv=uv,
        nominal={
            "membrane_stiffness": float(off[0] * scene.sheet.membrane_stiffness),
            "poisson_ratio": NOMINAL_POISSON_RATIO,
            "bending_stiffness": float(off[1] * scene.plate.stiffness),
            "bending_damping_time": 0.015,
        },
    )


def _report(t: Array, pose: Array, rng: np.random.Generator) -> recordings.GripperMotion:
    """Return what the robot says: it holds the cloth about a millimetre beside."""
    shift = GRIP_POSITION_STD_M * rng.standard_normal(3) / np.sqrt(3)
    quat = Rotation.from_matrix(pose[:, :3, :3]).as_quat(scalar_first=True)
    return recordings.GripperMotion(t, pose[:, :3, 3] + shift, quat, np.ones(len(t), bool))


class _Observed(NamedTuple):
    camera: observe.DepthCamera
    clouds: list[Array]
    counts: Array
    occluded: float
    removed: float
    foreign: float


def _arm_meshes(rig: Rig, joints: Mapping[str, Array], hold: _Hold, poses: Mapping[str, Array]) -> list[list[Mesh]]:
    """Return the solids of arms and clamps at every frame."""
    solids = rig.geometry({name: torch.as_tensor(joints[name]) for name in ARM_SIDES})
    frames = [observe.build_solid_meshes(solids, at=k) for k in range(len(next(iter(joints.values()))))]
    for name, points in hold.points.items():
        if len(points) > 1:
            length = float(np.ptp(points[:, 0])) + 2 * hold.radius
            for frame, pose in zip(frames, poses[name], strict=True):
                above = pose.copy()
                above[2, 3] += CLAMP_BAR_HEIGHT_M + CLAMP_BAR_SIZE_M[1] / 2
                frame.append(observe.build_solid_mesh("box", (CLAMP_BAR_SIZE_M[0], length, CLAMP_BAR_SIZE_M[1]), above))
    return frames


def _observe(
    rng: np.random.Generator,
    name: str,
    sheet: SheetSpec,
    x: Array,
    arms: Sequence[list[Mesh]],
    poses: Mapping[str, Array],
    rig: Rig,
    size: MovingSize,
) -> _Observed:
    """Take depth images of everything, and cut the cloth out of them."""
    faces = sheet_mesh(sheet)[1]
    camera = shrink_camera(place_camera(rng, name, x, AZIMUTH_RANGE_RAD), size.shrink)
    noise = make_camera_noise(name)
    view = observe.View(camera, noise).with_bias(rng)
    grips = np.concatenate([pose[:, :3, 3] for pose in poses.values()])
    reach = float(np.hypot(sheet.width, sheet.height)) + WORKSPACE_MARGIN_M
    low, high = grips.min(0) - reach, grips.max(0) + reach
    low[2], high[2] = SEGMENTED_TABLE_MARGIN_M, grips[:, 2].max() + WORKSPACE_MARGIN_M
    stages = observe.Segmentation(
        workspace_low=tuple(low),
        workspace_high=tuple(high),
        robot_margin=ROBOT_MARGIN_M[name],
        table=(0.0, 0.0, 1.0, 0.0),
        table_margin=SEGMENTED_TABLE_MARGIN_M,
        isolation_radius=ISOLATION_RADIUS_M,
        isolation_neighbours=ISOLATION_NEIGHBOURS,
        grasp_distance=GRASP_DISTANCE_FRACTION * float(np.hypot(sheet.width, sheet.height)),
    )
    pixels = np.zeros((camera.height, camera.width), bool)
    stride = max(1, PIXEL_STRIDE // size.shrink)
    pixels[::stride, ::stride] = True
    background = [*observe.build_solid_meshes([rig.table.primitive()]), *build_room()]  # type: ignore[union-attr]
    bar_width, tilt = rng.uniform(*BAR_WIDTH_RANGE), BAR_TILT_STD_RAD * rng.standard_normal()
    direction = rng.choice([-1.0, 1.0])
    clouds, occluded, removed, foreign = [], [], [], []
    for k, frame in enumerate(x):
        bar = _bar(camera, frame, bar_width, direction * (2 * k / max(len(x) - 1, 1) - 1), tilt)
        depth, ids = observe.render_depth(camera, [(frame, faces), *arms[k], bar, *background])
        alone, _ = observe.render_depth(camera, [(frame, faces)])
        noisy = noise.apply(depth, rng, view.bias)
        grasps = np.stack([pose[k, :3, 3] for pose in poses.values()])
        result = observe.segment_depth(camera, noisy, stages, mask=pixels, robot=arms[k], grasps=grasps)
        is_cloth = (ids == 0)[(noisy > 0) & pixels]
        clouds.append(observe.thin_to_count(result.points, MAX_POINTS, rng) if len(result.points) else result.points)
        occluded.append(1 - (ids == 0).sum() / max(int((alone > 0).sum()), 1))
        removed.append(1 - len(result.points) / max(int((ids == 0)[pixels].sum()), 1))
        if len(result.indices):
            foreign.append(1 - is_cloth[result.indices].mean())
    counts = np.array([len(cloud) for cloud in clouds])
    return _Observed(
        camera, clouds, counts, *(float(np.mean(share or [0.0])) for share in (occluded, removed, foreign))
    )


def _bar(camera: observe.DepthCamera, x: Array, width: float, place: float, tilt: float) -> Mesh:
    """Return a bar in front of the cloth.

    Args:
        camera: that it hides the cloth from.
        x: [V, 3] m, the cloth.
        width: over that of the cloth in the image.
        place: -1: at the left edge of the cloth in the image, 1: at its right edge.
        tilt: rad, about the line of sight.
    """
    T = camera.T_world_camera
    local = (x - T[:3, 3]) @ T[:3, :3]
    across, up = (local[:, k] / local[:, 2] for k in (0, 1))
    depth = (1 - BAR_PLACE_FRACTION) * float(local[:, 2].mean())
    half = np.ptp(across) / 2
    middle = (across.min() + across.max()) / 2 + place * (1 - width) * half
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec([0.0, 0.0, tilt]).as_matrix()
    pose[:3, 3] = depth * np.array([middle, (up.min() + up.max()) / 2, 1.0])
    return observe.build_solid_mesh("box", (2 * width * half * depth, BAR_LENGTH_M, 0.02), T @ pose)
