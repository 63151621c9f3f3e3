"""A depth sensor by numpy alone: noisy points of the sheet's surface, and errors of the sensor.

It is faster than the ray-cast camera of kinect_camera.py. Points are drawn from the whole surface, uniformly over the
fabric, and carry noise along the camera's rays. Layers do not hide each other.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from torchcloth.recordings import PointClouds

from .flex_sheet import SheetSpec, interpolate_bilinear

Array = np.ndarray
EYE_M = (1.66, 0.55, 0.60)  # the camera's usual position
TARGET_M = (0.50, 0.0, 0.30)
# Middle of a hanging sheet of 0.3 m. A camera that is turned about another point is displaced as well.
ROTATION_CENTRE_M = (0.50, 0.0, 0.25)
BIAS_MODES = 6  # low-order polynomials over the image
BIAS_MODE_HALF_WIDTH = 0.12  # normalised image coordinate at which the modes are one: 0.15 m at 1.25 m
BIAS_MODE_MEAN_SQUARES = 2.18  # sum of the modes' mean squares over that image


@dataclass(frozen=True)
class SensorSpec:
    """The sensor and its errors.

    Attributes:
        rate: Hz, of the frames.
        points: per frame.
        noise: m, standard deviation along the ray.
        bias: m, standard deviation of a slowly varying depth error of 6 low-order modes over the image.
        bias_memory: -, coefficient of the modes' autoregression from frame to frame.
        occlusion: -, fraction of the surface behind a bar that moves across the view.
        edge: m, band along the sheet's edges that is not seen.
        delay: s, by which the stamps are later than the light.
        shift: m, by which the camera is believed to stand further along ``heading`` than it does.
        heading: degrees (0: +x, 90: +y).
        rotation: rad, by which the camera is believed to be turned about the vertical.
        lean: rad, by which it is believed to be turned about ``ROTATION_CENTRE_M``, around ``heading``.
        scale: -, fraction by which depths read too large.
        offset: m, added to the depths.
        eye: m, the camera's position.
        target: m, the point at which it looks.
        roll: rad, by which it is turned about the line of sight.
    """

    rate: float = 30.0
    points: int = 250
    noise: float = 1e-3
    bias: float = 0.0
    bias_memory: float = 0.9
    occlusion: float = 0.0
    edge: float = 0.0
    delay: float = 0.0
    shift: float = 0.0
    heading: float = 0.0
    rotation: float = 0.0
    lean: float = 0.0
    scale: float = 0.0
    offset: float = 0.0
    eye: tuple[float, float, float] = EYE_M
    target: tuple[float, float, float] = TARGET_M
    roll: float = 0.0

    @property
    def position(self) -> Array:
        """Position of the camera [3] m."""
        return np.array(self.eye)

    @property
    def axes(self) -> Array:
        """Unit vectors [3, 3] to the right, down and ahead."""
        ahead = np.array(self.target) - self.position
        ahead /= np.linalg.norm(ahead)
        right = np.cross(ahead, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(ahead, right), ahead]) @ Rotation.from_rotvec(self.roll * ahead).as_matrix().T


def sample_points(spec: SensorSpec, sheet: SheetSpec, t: Array, x: Array, rng: np.random.Generator) -> PointClouds:
    """Return points of the true motion x [K, V, 3] m at t [K] s, at the sensor's own frame times."""
    stamps = np.arange(int((t[-1] - t[0]) * spec.rate + 1e-9) + 1) / spec.rate + t[0]
    stamps = stamps[stamps - spec.delay <= t[-1] + 1e-9]  # of later light nothing is known
    frames = CubicSpline(t, x)(np.maximum(stamps - spec.delay, t[0]))
    bias_modes = np.zeros(BIAS_MODES)
    clouds = []
    for i, frame in enumerate(frames):
        # drawn before anything depends on an effect, so that two episodes of a seed differ by the effect alone
        uv, noise = rng.random((4 * spec.points, 2)), rng.standard_normal(4 * spec.points)
        fresh = rng.standard_normal(BIAS_MODES)
        bias_modes = fresh if i == 0 else spec.bias_memory * bias_modes + np.sqrt(1 - spec.bias_memory**2) * fresh
        visible_size = np.array([sheet.width, sheet.height]) - 2 * spec.edge
        points = interpolate_bilinear(sheet, frame, spec.edge + uv * visible_size)[0]
        is_occluded = _is_occluded(spec, points, frame, i / max(len(frames) - 1, 1))
        chosen = np.flatnonzero(~is_occluded)[: spec.points]
        clouds.append(_measure(spec, points[chosen], noise[chosen], bias_modes))
    return PointClouds(stamps, np.concatenate(clouds), np.array([len(c) for c in clouds]))


def _measure(spec: SensorSpec, points: Array, noise: Array, bias_modes: Array) -> Array:
    """Return the measured positions [N, 3] m of true points [N, 3] m."""
    ray = points - spec.position
    depth = np.linalg.norm(ray, axis=1)
    bias = spec.bias / np.sqrt(BIAS_MODE_MEAN_SQUARES) * (bias_modes @ depth_error_modes(spec, points))
    depth = depth * (1 + spec.scale) + spec.offset + spec.noise * noise + bias
    measured = ray / np.linalg.norm(ray, axis=1, keepdims=True) * depth[:, None]
    turn, position = _believed_pose(spec)
    return position + measured @ turn.T


def depth_error_modes(spec: SensorSpec, points: Array) -> Array:
    """Return the modes [6, N] of a slow depth error at points [N, 3] m: low-order polynomials over the image."""
    across, up = _image_coordinates(spec, points).T
    modes = np.stack([np.ones(len(points)), across, up, across * up, across**2, up**2])
    return modes * (1 / BIAS_MODE_HALF_WIDTH) ** np.array([0, 1, 1, 2, 2, 2])[:, None]


def pinhole_camera(spec: SensorSpec) -> dict[str, Any]:
    """Return the fields of a recording's camera (OpenCV): its believed pose, and a lens that holds the scene."""
    turn, position = _believed_pose(spec)
    pose = np.eye(4)
    pose[:3, :3] = turn @ spec.axes.T
    pose[:3, 3] = position
    lens = np.array([[504.0, 0.0, 320.0], [0.0, 504.0, 288.0], [0.0, 0.0, 1.0]])
    return {"width": 640, "height": 576, "K": lens, "T_world_camera": pose}


def _believed_pose(spec: SensorSpec) -> tuple[Array, Array]:
    """Return the rotation [3, 3] from the true to the believed pose, and the believed position [3] m."""
    angle = np.deg2rad(spec.heading)
    along = np.array([np.cos(angle), np.sin(angle), 0.0])
    lean = Rotation.from_rotvec(spec.lean * along).as_matrix()
    turn = lean @ Rotation.from_rotvec([0.0, 0.0, spec.rotation]).as_matrix()
    arm = spec.position - np.array(ROTATION_CENTRE_M)
    return turn, spec.position + (lean - np.eye(3)) @ arm + spec.shift * along


def _image_coordinates(spec: SensorSpec, points: Array) -> Array:
    """Return normalised image coordinates [N, 2] of points [N, 3] m: to the left and up."""
    right, down, ahead = spec.axes
    ray = points - spec.position
    return np.stack([ray @ -right, ray @ -down], 1) / (ray @ ahead)[:, None]


def _is_occluded(spec: SensorSpec, points: Array, frame: Array, time_fraction: float) -> Array:
    """Return which points [N] lie behind a vertical bar that moves once from left to right."""
    if not spec.occlusion:
        return np.zeros(len(points), bool)
    low, high = np.quantile(_image_coordinates(spec, frame)[:, 0], [0.0, 1.0])
    width = spec.occlusion * (high - low)
    left = high - width - time_fraction * (high - low - width)
    across = _image_coordinates(spec, points)[:, 0]
    return (across > left) & (across < left + width)
