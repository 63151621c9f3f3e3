"""Clouds of simulated cloth, with the faults of a real bench.

A camera of a random place looks at the scene: a Kinect or a RealSense at a quarter of its resolution, with its errors
scaled. Arms and a passing bar hide parts. The mask of the cloth is eaten from its rim and near the fingers, and some
points are of something else. The camera lags behind the grippers; its pose and theirs are wrong by millimetres.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from torchcloth.boundaries.motion import interpolate_poses
from torchcloth.observe import (
    AbstractNoise,
    DepthCamera,
    DepthNoise,
    StereoNoise,
    build_solid_mesh,
    erode,
    look_at,
    render_depth,
    to_points,
)
from torchcloth.observe.cloud import select_by_spacing

from .scenes import POSE_FRAME_PERIOD_S, Scene, SimulatedScene

Array = np.ndarray
SolidMesh = tuple[Array, Array]

POINT_COUNT = 256
RESOLUTION_DIVISOR = 4  # a full image takes 60 to 100 ms
CROP_MARGIN_PX = (16, 3)  # to the left, as stereo cameras see nothing at the left rim of an image; and elsewhere
MIN_CLOUD_PIXELS = 24  # of a frame with a cloud
SHARE_WITH_PASSING_BAR = 0.4
SHARE_WITH_PREVIOUS = 0.5
DENSE_CLOUD_FACTOR = 10  # more points than this times those wanted are thinned at random first
MAX_HIDDEN_FRACTION = 0.4  # by the passing bar
MAX_STRAY_POINT_FRACTION = 0.03
STRAY_REACH_PX = 4  # from the mask of the cloth; farther pixels are not taken for cloth
MAX_STEREO_BIAS_FRACTION = 0.7  # of the error of scale out of the box; most benches have calibrated a part of it
LARGEST_LAG_S, JITTER_STD_S = 0.040, 0.004
TABLE_HALF_WIDTH_M = 1.5


class SensorSetup(NamedTuple):
    """A camera and all its faults in a scene.

    Attributes:
        camera: at its true place, of the reduced resolution.
        assumed_pose: [4, 4] camera to world, as calibrated.
        noise: its errors.
        bias: [..., H, W] of the device; None: no bias.
        erosion: px of the reduced image, which the segmentation takes from the rim.
        finger_clearance: m, within which the segmentation removes cloth near a gripper.
        stray_fraction: of the points that are not of the cloth.
        lag: s, by which a cloud is older than the gripper poses of the same stamp.
    """

    camera: DepthCamera
    assumed_pose: Array
    noise: AbstractNoise
    bias: Array | None
    erosion: int
    finger_clearance: float
    stray_fraction: float
    lag: float


class Frames(NamedTuple):
    """What a robot knows of T frames of a scene.

    Attributes:
        index: [T] of the simulated frames.
        times: [T] s, of the clouds.
        points: [T, N, 3] m, clouds of ``POINT_COUNT`` points, some repeated where fewer are seen.
        grip_position: [T, 2, 3] m, centre of what each gripper holds, as reported; NaN: no such gripper.
        grip_velocity: [T, 2, 3] m/s.
        previous_error: [T, V, 3] m, error of the estimate of the frame before; NaN: there is no estimate.
        visible: [T], share of the cloth's pixels that occluders leave.
        is_stray: [T, N] bool, points that are not of the cloth.
    """

    index: Array
    times: Array
    points: Array
    grip_position: Array
    grip_velocity: Array
    previous_error: Array
    visible: Array
    is_stray: Array


def observe_scene(simulated: SimulatedScene, frames: Sequence[int], rng: np.random.Generator) -> Frames:
    """Observe frames of a simulated scene.

    Args:
        simulated: the scene.
        frames: [T] indices of its frames; frames without enough visible cloth are left out of the result.
        rng: source of the camera, the occluders and all errors.
    """
    scene, times = simulated.scene, simulated.times[np.asarray(frames, int)]
    setup = draw_sensor(simulated, rng)
    arms, bar = draw_arms(scene, rng), _draw_passing_bar(simulated, setup.camera, rng)
    poses = gripper_poses(scene, times)
    position, velocity = _report_grips(simulated, times + setup.lag + JITTER_STD_S * rng.standard_normal(len(times)))
    position += rng.normal(0.0, 1.0, (2, 3)) * rng.uniform(0.5e-3, 1.7e-3)  # of the calibration of each arm
    position += rng.normal(0.0, 0.3e-3, position.shape)
    velocity += rng.normal(0.0, 0.01, velocity.shape)
    error_scale = rng.uniform(2e-3, 1e-2)
    error = np.full((len(times), *simulated.x.shape[1:]), np.nan)
    clouds = []
    for row, frame in enumerate(frames):
        solids = [solid for arm, pose in zip(arms, poses[:, row], strict=True) for solid in place_arm(arm, pose)]
        if bar is not None:
            solids.append(bar(float(times[row])))
        clouds.append(_capture(setup, simulated.true_x[frame], scene, solids, poses[:, row, :3, 3], rng))
        if frame > 0 and rng.random() < SHARE_WITH_PREVIOUS:
            error[row] = error_scale * rng.uniform(0.6, 1.4) * _smooth_error(simulated.x[frame - 1], rng)
    seen = [row for row, cloud in enumerate(clouds) if cloud is not None]
    columns = list(zip(*(cloud for cloud in clouds if cloud is not None), strict=True)) or [()] * 3
    points, is_stray, visible = (np.array(column) for column in columns)
    indices = np.asarray(frames, int)[seen]
    return Frames(indices, times[seen], points, position[seen], velocity[seen], error[seen], visible, is_stray)


# -- camera -----------------------------------------------------------------------------------------------------------


def draw_sensor(simulated: SimulatedScene, rng: np.random.Generator) -> SensorSetup:
    """Draw a camera that looks at the scene, and its faults."""
    x = simulated.true_x
    middle = (x.min((0, 1)) + x.max((0, 1))) / 2
    azimuth = rng.uniform(-math.pi, math.pi)
    low = 15.0 if simulated.scene.has_table else -10.0
    elevation = math.radians(rng.uniform(low, 60.0))
    direction = np.array(
        [math.cos(azimuth) * math.cos(elevation), math.sin(azimuth) * math.cos(elevation), math.sin(elevation)]
    )
    radius = 0.5 * float(np.ptp(x, axis=(0, 1)).max())
    eye = middle + direction * max(rng.uniform(0.7, 1.6), radius + 0.35)
    pose = look_at(eye, middle + rng.normal(0.0, 0.04, 3))
    camera, noise = _build_camera(pose, bool(rng.random() < 0.5), rng)
    bias = noise.bias_field((camera.height, camera.width), rng) if noise.has_bias else None
    error = np.eye(4)
    error[:3, :3] = Rotation.from_rotvec(math.radians(rng.uniform(0.0, 0.3)) * _unit(rng)).as_matrix()
    assumed = error @ pose
    assumed[:3, 3] = pose[:3, 3] + rng.uniform(0.0, 5e-3) * _unit(rng)
    return SensorSetup(
        camera,
        assumed,
        noise,
        bias,
        erosion=int(rng.choice((0, 1, 2), p=(0.5, 0.38, 0.12))),
        finger_clearance=float(rng.choice((0.0, rng.uniform(0.01, 0.04)))),
        stray_fraction=float(rng.choice((0.0, rng.uniform(0.0, MAX_STRAY_POINT_FRACTION)))),
        lag=rng.uniform(0.0, LARGEST_LAG_S),
    )


def _build_camera(pose: Array, is_stereo: bool, rng: np.random.Generator) -> tuple[DepthCamera, AbstractNoise]:
    """Return a camera at a quarter of its resolution, without distortion, and its errors at that resolution."""
    full = DepthCamera.realsense_d435(pose) if is_stereo else DepthCamera.azure_kinect_nfov(pose).without_distortion()
    scale = 1 / RESOLUTION_DIVISOR
    K = full.K.copy()
    K[:2] *= scale
    K[:2, 2] -= 0.5 * (1 - scale)  # the centre of a pixel is at an integer
    camera = replace(full, width=full.width // RESOLUTION_DIVISOR, height=full.height // RESOLUTION_DIVISOR, K=K)
    if is_stereo:
        noise = StereoNoise.d435()
        return camera, replace(
            noise,
            focal=scale * noise.focal,
            subpixel=scale * noise.subpixel,
            patch=scale * noise.patch,
            step=scale * noise.step,
            fattening=0,
            edge=scale * noise.edge,
            bias_disparity=scale * noise.bias_disparity,
            bias_scale=MAX_STEREO_BIAS_FRACTION * rng.random() * noise.bias_scale,
            bias_length=scale * noise.bias_length,
        )
    noise = DepthNoise.azure_kinect()
    return camera, replace(
        noise,
        jitter=scale * noise.jitter,
        bias_length=scale * noise.bias_length,
        flying_fraction=scale * noise.flying_fraction,
    )


def _capture(
    setup: SensorSetup,
    x: Array,
    scene: Scene,
    solids: Sequence[SolidMesh],
    grips: Array,
    rng: np.random.Generator,
) -> tuple[Array, Array, float] | None:
    """Return the points [N, 3] m, which of them are stray, and the visible share; None if hardly any cloth is seen."""
    crop = _crop_to(setup.camera, x)
    if crop is None:
        return None
    camera, window = crop
    cloth_body = x, scene.shape.true_mesh.faces
    others = _join([*solids, *([_TABLE] if scene.has_table else [])])
    clean, ids = render_depth(camera, [cloth_body, others])
    depth = setup.noise.apply(clean, rng, None if setup.bias is None else setup.bias[(..., *window)])
    shown = ids == 0
    assumed = replace(camera, T_world_camera=setup.assumed_pose)
    cloth = to_points(assumed, depth, erode(shown, setup.erosion))
    if setup.finger_clearance:
        distance = np.linalg.norm(cloth[:, None] - grips, axis=-1).min(1)
        cloth = cloth[distance > setup.finger_clearance]
    if len(cloth) < MIN_CLOUD_PIXELS:
        return None
    stray_count = rng.binomial(POINT_COUNT, setup.stray_fraction)
    if stray_count:
        stray = to_points(assumed, depth, ~erode(~shown, STRAY_REACH_PX) & (ids == 1))
        stray = stray[rng.permutation(len(stray))[:stray_count]]
    else:
        stray = cloth[:0]
    cloth = thin_uniformly(cloth, POINT_COUNT - len(stray), float(scene.shape.true_mesh.area.sum()), rng)
    is_stray = np.arange(POINT_COUNT) >= len(cloth)
    alone = render_depth(camera, [cloth_body])[1] == 0
    return np.concatenate([cloth, stray]), is_stray, float(shown.sum() / max(1, alone.sum()))


def _join(bodies: Sequence[SolidMesh]) -> SolidMesh:
    """Return several meshes as one."""
    firsts = np.cumsum([0, *(len(vertices) for vertices, _ in bodies)])
    faces = [faces + first for (_, faces), first in zip(bodies, firsts, strict=False)]
    return np.concatenate([vertices for vertices, _ in bodies]), np.concatenate(faces)


def _crop_to(camera: DepthCamera, x: Array) -> tuple[DepthCamera, tuple[slice, slice]] | None:
    """Return the camera of the part of the image that shows vertices [W, 3], and its rows and columns."""
    pixels, depth = camera.project(x)
    pixels = pixels[depth > 0.05]
    if not len(pixels):
        return None
    left, other = CROP_MARGIN_PX
    low = np.maximum(np.floor(pixels.min(0)).astype(int) - [left, other], 0)
    high = np.minimum(np.ceil(pixels.max(0)).astype(int) + other + 1, [camera.width, camera.height])
    if (high - low < 4).any():
        return None
    K = camera.K.copy()
    K[:2, 2] -= low
    width, height = (int(size) for size in high - low)
    return replace(camera, width=width, height=height, K=K), (slice(low[1], high[1]), slice(low[0], high[0]))


def thin_uniformly(points: Array, count: int, area: float, rng: np.random.Generator) -> Array:
    """Return ``count`` of the points [N, 3] m, evenly over the surface and not over pixels; repeated if too few.

    Args:
        points: [N, 3] m.
        count: of the points.
        area: m^2, of the cloth, from which the spacing is estimated.
        rng: source of the choice.
    """
    if len(points) > count:
        if len(points) > DENSE_CLOUD_FACTOR * count:
            points = points[rng.choice(len(points), DENSE_CLOUD_FACTOR * count, replace=False)]
        spacing = 1.3 * math.sqrt(area / count)
        for _ in range(6):
            chosen = select_by_spacing(points + rng.uniform(0.0, spacing, 3), spacing)
            if len(chosen) >= count:
                return points[rng.permutation(chosen)[:count]]
            spacing *= 0.8
        others = np.setdiff1d(np.arange(len(points)), chosen)
        return points[np.concatenate([chosen, rng.permutation(others)])[:count]]
    repeated = rng.integers(len(points), size=count - len(points))
    return points[np.concatenate([np.arange(len(points)), repeated])]


# -- occluders --------------------------------------------------------------------------------------------------------


class Arm(NamedTuple):
    """An arm as boxes in the frame of its gripper.

    Attributes:
        boxes: edges [3] m and pose [4, 4] in the gripper's frame of each box.
    """

    boxes: list[tuple[tuple[float, float, float], Array]]


def draw_arms(scene: Scene, rng: np.random.Generator) -> list[Arm]:
    """Draw an arm for each gripper: two fingers, a hand and a forearm that lead away from the cloth."""
    arms = []
    for name, index in zip(scene.motion, scene.shape.true_grips, strict=True):
        pose = scene.motion[name].pose[0].numpy()
        inwards = scene.start.mean(0) - pose[:3, 3]
        inwards /= max(float(np.linalg.norm(inwards)), 1e-9)
        lowest = 0.3 if scene.has_table else -0.5
        while True:
            away = _unit(rng)
            if away @ inwards < 0.2 and away[2] > lowest:
                break
        axes = _frame_along(away, rng)
        opening = rng.uniform(0.006, 0.02)
        finger = (rng.uniform(0.012, 0.03), 0.008, rng.uniform(0.03, 0.06))
        hand = rng.uniform(0.06, 0.12)
        boxes = [_box(finger, axes, np.array([0.0, side * opening / 2, finger[2] / 2 - 0.012])) for side in (-1, 1)]
        start = finger[2] - 0.012
        boxes.append(
            _box((rng.uniform(0.05, 0.1), rng.uniform(0.05, 0.2), hand), axes, np.array([0, 0, start + hand / 2]))
        )
        thickness, length = rng.uniform(0.06, 0.12), rng.uniform(0.3, 0.6)
        bent = _frame_along(away + 0.5 * rng.normal(0.0, 1.0, 3), rng)
        elbow = axes @ np.array([0.0, 0.0, start + hand])
        boxes.append(_box((thickness, thickness, length), bent, np.array([0.0, 0.0, length / 2]), elbow))
        if scene.shape.grip_kind == "bar":  # a rod along the edge that is held
            edge = scene.start[index]
            along = edge[-1] - edge[0]
            rod = _frame_along(along, rng)
            thick = rng.uniform(0.008, 0.02)
            boxes.append(_box((thick, thick, float(np.linalg.norm(along)) + 0.04), rod, np.zeros(3)))
        arms.append(Arm(boxes))
    return arms


def place_arm(arm: Arm, pose: Array) -> list[SolidMesh]:
    """Return the boxes of an arm at a pose [4, 4] of its gripper."""
    return [build_solid_mesh("box", size, pose @ local) for size, local in arm.boxes]


def _draw_passing_bar(simulated: SimulatedScene, camera: DepthCamera, rng: np.random.Generator):
    """Return a function time -> bar that passes between camera and cloth; None: there is no bar."""
    if rng.random() > SHARE_WITH_PASSING_BAR:
        return None
    x = simulated.true_x
    middle, eye = (x.min((0, 1)) + x.max((0, 1))) / 2, camera.T_world_camera[:3, 3]
    fraction = rng.uniform(0.4, 0.75)  # of the way from the camera
    right, down = camera.T_world_camera[:3, 0], camera.T_world_camera[:3, 1]
    angle = rng.uniform(-math.pi, math.pi)
    across = math.cos(angle) * right + math.sin(angle) * down
    extent = float(np.ptp(x[len(x) // 2] @ across))
    width = fraction * extent * rng.uniform(0.15, MAX_HIDDEN_FRACTION)
    axes = _frame_along(np.cross(across, middle - eye), rng)
    axes = np.stack([across, np.cross(axes[:, 2], across), axes[:, 2]], 1)
    amplitude, period, phase = 0.6 * extent * fraction, rng.uniform(1.0, 4.0), rng.uniform(0, 2 * math.pi)

    def bar(time: float) -> SolidMesh:
        shift = amplitude * math.sin(2 * math.pi * time / period + phase)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = axes, eye + fraction * (middle - eye) + shift * across
        return build_solid_mesh("box", (width, 0.01, 1.5), pose)

    return bar


def _box(size: tuple[float, float, float], axes: Array, centre: Array, origin: Array | None = None):
    pose = np.eye(4)
    pose[:3, :3] = axes
    pose[:3, 3] = axes @ centre + (0.0 if origin is None else origin)
    return size, pose


def _frame_along(direction: Array, rng: np.random.Generator) -> Array:
    """Return a rotation [3, 3] whose third axis is along a direction [3]."""
    third = direction / max(float(np.linalg.norm(direction)), 1e-9)
    first = np.cross(third, _unit(rng))
    first /= max(float(np.linalg.norm(first)), 1e-9)
    return np.stack([first, np.cross(third, first), third], 1)


def _unit(rng: np.random.Generator) -> Array:
    vector = rng.standard_normal(3)
    return vector / np.linalg.norm(vector)


_TABLE: SolidMesh = (
    TABLE_HALF_WIDTH_M * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]]),
    np.array([[0, 1, 2], [0, 2, 3]]),
)


# -- what the robot reports -------------------------------------------------------------------------------------------


def gripper_poses(scene: Scene, times: Array) -> Array:
    """Return the true poses of the grippers at times [T] s, [G, T, 4, 4]; at rest before 0 s."""
    t = torch.as_tensor(np.clip(times, 0.0, None))
    return np.stack([interpolate_poses(path, t.clamp(max=float(path.t[-1]))).numpy() for path in scene.motion.values()])


def _report_grips(simulated: SimulatedScene, times: Array) -> tuple[Array, Array]:
    """Return position and velocity [T, 2, 3] of the centres of what grippers hold on the network's mesh; NaN: none."""
    scene, step = simulated.scene, 0.25 * POSE_FRAME_PERIOD_S
    poses = [gripper_poses(scene, times + shift) for shift in (-step, 0.0, step)]
    out = np.full((2, len(times), 2, 3), np.nan)
    for k, index in enumerate(scene.shape.grips):
        start = gripper_poses(scene, np.zeros(1))[k, 0]
        local = np.linalg.solve(start, np.append(simulated.x[0, index].mean(0), 1.0))
        before, now, after = (pose[k] @ local for pose in poses)
        out[0, :, k], out[1, :, k] = now[:, :3], (after - before)[:, :3] / (2 * step)
    return out[0], out[1]


def _smooth_error(x: Array, rng: np.random.Generator, waves: int = 6) -> Array:
    """Return a smooth random field [V, 3] of unit root mean square over places [V, 3] m."""
    frequency = rng.normal(0.0, 12.0, (waves, 3))  # rad/m: over some decimetres
    phase = rng.uniform(0, 2 * math.pi, waves)
    field = np.cos(x @ frequency.T + phase) @ rng.normal(0.0, 1.0, (waves, 3))
    return field / max(float(np.sqrt((field**2).mean())), 1e-9)
