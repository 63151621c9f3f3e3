"""Noisy points of the sheet's surface, by numpy alone, and what a sensor may do to them.

Quicker than the ray-cast camera of kinect_view.py: points are drawn from the whole surface, uniformly over the fabric,
and carry noise along the camera's rays. Layers do not hide each other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from torchcloth.recordings import PointClouds

from .flex_sheet import SheetSpec, bilinear

Array = np.ndarray
EYE = (1.66, 0.55, 0.60)  # m, the camera's usual place
TARGET = (0.50, 0.0, 0.30)
MIDDLE = (0.50, 0.0, 0.25)  # of a sheet of 0.3 m that hangs: a camera that leans about another place is elsewhere, too


@dataclass(frozen=True)
class SensorSpec:
    """The sensor and its errors.

    Attributes:
        rate: Hz, of the frames.
        points: per frame.
        noise: m, standard deviation along the ray.
        bias: m, standard deviation of a slowly varying depth error: 6 low-order modes over the image, each an
            autoregression of ``bias_memory`` from frame to frame.
        occlusion: -, share of the surface behind something that moves across the view.
        edge: m, band along the sheet's edges that is not seen.
        delay: s, by which the stamps are later than the light.
        shift: m, by which the camera is believed to stand further along ``heading`` degrees than it does;
            ``rotation`` rad, by which it is believed to be turned about the vertical.
        lean: rad, by which it is believed to be turned, about ``MIDDLE``, around ``heading`` by the right hand.
        scale: -, share by which depths read too large; ``offset`` m is added to them.
        eye: m, where the camera is; ``target`` m, what it looks at; ``roll`` rad, by which it is turned about that way.
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
    eye: tuple[float, float, float] = EYE
    target: tuple[float, float, float] = TARGET
    roll: float = 0.0

    @property
    def place(self) -> Array:
        """[3] m, of the camera."""
        return np.array(self.eye)

    @property
    def axes(self) -> Array:
        """[3, 3] unit vectors to the right, down and ahead."""
        ahead = np.array(self.target) - self.place
        ahead /= np.linalg.norm(ahead)
        right = np.cross(ahead, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(ahead, right), ahead]) @ Rotation.from_rotvec(self.roll * ahead).as_matrix().T


def see(spec: SensorSpec, sheet: SheetSpec, t: Array, x: Array, rng: np.random.Generator) -> PointClouds:
    """Points of the true motion x [K, V, 3] m at t [K] s, at the sensor's own frame times."""
    stamps = np.arange(int((t[-1] - t[0]) * spec.rate + 1e-9) + 1) / spec.rate + t[0]
    stamps = stamps[stamps - spec.delay <= t[-1] + 1e-9]  # of later light nothing is known
    frames = CubicSpline(t, x)(np.maximum(stamps - spec.delay, t[0]))
    walk = np.zeros(6)
    clouds = []
    for i, frame in enumerate(frames):
        # drawn before anything depends on an effect, so that two episodes of a seed differ by the effect alone
        uv, noise = rng.random((4 * spec.points, 2)), rng.standard_normal(4 * spec.points)
        fresh = rng.standard_normal(6)
        walk = fresh if i == 0 else spec.bias_memory * walk + np.sqrt(1 - spec.bias_memory**2) * fresh
        room = np.array([sheet.width, sheet.height]) - 2 * spec.edge
        points = bilinear(sheet, frame, spec.edge + uv * room)[0]
        seen = np.flatnonzero(~_hidden(spec, points, frame, i / max(len(frames) - 1, 1)))[: spec.points]
        clouds.append(_measured(spec, points[seen], noise[seen], walk))
    return PointClouds(stamps, np.concatenate(clouds), np.array([len(c) for c in clouds]))


def _measured(spec: SensorSpec, points: Array, noise: Array, walk: Array) -> Array:
    ray = points - spec.place
    depth = np.linalg.norm(ray, axis=1)
    across, up = _image(spec, points).T
    modes = np.stack([np.ones(len(points)), across, up, across * up, across**2, up**2])
    # modes of unit size at +-0.12 (0.15 m at 1.25 m); their mean squares over that image add up to 2.18
    modes *= (1 / 0.12) ** np.array([0, 1, 1, 2, 2, 2])[:, None]
    slow = spec.bias / np.sqrt(2.18) * (walk @ modes)
    depth = depth * (1 + spec.scale) + spec.offset + spec.noise * noise + slow
    found = ray / np.linalg.norm(ray, axis=1, keepdims=True) * depth[:, None]
    turn, place = _believed(spec)
    return place + found @ turn.T


def pinhole(spec: SensorSpec) -> dict[str, object]:
    """Where the camera is believed to be, and a lens that holds the scene: fields of a recording's camera (OpenCV)."""
    turn, place = _believed(spec)
    pose = np.eye(4)
    pose[:3, :3] = turn @ spec.axes.T
    pose[:3, 3] = place
    lens = np.array([[504.0, 0.0, 320.0], [0.0, 504.0, 288.0], [0.0, 0.0, 1.0]])
    return {"width": 640, "height": 576, "K": lens, "T_world_camera": pose}


def _believed(spec: SensorSpec) -> tuple[Array, Array]:
    """Turn [3, 3] of the camera's believed pose from its true one, and its believed place [3] m."""
    angle = np.deg2rad(spec.heading)
    along = np.array([np.cos(angle), np.sin(angle), 0.0])
    lean = Rotation.from_rotvec(spec.lean * along).as_matrix()
    turn = lean @ Rotation.from_rotvec([0.0, 0.0, spec.rotation]).as_matrix()
    return turn, spec.place + (lean - np.eye(3)) @ (spec.place - np.array(MIDDLE)) + spec.shift * along


def _image(spec: SensorSpec, points: Array) -> Array:
    """Normalised image coordinates [N, 2] of points [N, 3]: to the left and up."""
    right, down, ahead = spec.axes
    ray = points - spec.place
    return np.stack([ray @ -right, ray @ -down], 1) / (ray @ ahead)[:, None]


def _hidden(spec: SensorSpec, points: Array, frame: Array, time: float) -> Array:
    """Which points lie behind a vertical bar that moves from left to right once; its width covers the share."""
    if not spec.occlusion:
        return np.zeros(len(points), bool)
    low, high = np.quantile(_image(spec, frame)[:, 0], [0.0, 1.0])
    width = spec.occlusion * (high - low)
    left = high - width - time * (high - low - width)
    place = _image(spec, points)[:, 0]
    return (place > left) & (place < left + width)
