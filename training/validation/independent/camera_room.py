"""Depth cameras in a room: where they stand, their errors, and what lies behind the cloth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from torchcloth import observe

Array = np.ndarray
Mesh = tuple[Array, Array]
DISTANCE_RANGE_M = {"kinect": (1.0, 1.3), "realsense": (0.95, 1.2)}  # of the camera from the cloth
ELEVATION_RANGE_RAD = (0.0, 0.35)
WALL_X_M, FLOOR_Z_M = -0.6, -0.75
# The scale of a D435 is off by 2 % out of the box. The rig has corrected it on its own arms, to half a per cent.
CALIBRATED_STEREO_NOISE = replace(observe.StereoNoise.d435(), bias_scale=0.005)


def make_camera_noise(name: str) -> observe.AbstractNoise:
    """Return the errors of a camera, one of ``DISTANCE_RANGE_M``."""
    return observe.DepthNoise.azure_kinect() if name == "kinect" else CALIBRATED_STEREO_NOISE


def place_camera(rng: np.random.Generator, name: str, x: Array, max_azimuth: float) -> observe.DepthCamera:
    """Return a camera that looks at the middle of the cloth from the side away from the arms.

    Args:
        rng: source of its place.
        name: of the camera, one of ``DISTANCE_RANGE_M``.
        x: [T, V, 3] m, the cloth.
        max_azimuth: rad, to either side of +x.
    """
    target = (x.min((0, 1)) + x.max((0, 1))) / 2
    azimuth = rng.uniform(-max_azimuth, max_azimuth)
    elevation, distance = rng.uniform(*ELEVATION_RANGE_RAD), rng.uniform(*DISTANCE_RANGE_M[name])
    flat = np.cos(elevation)
    away = np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])
    make = observe.DepthCamera.azure_kinect_nfov if name == "kinect" else observe.DepthCamera.realsense_d435
    return make(observe.look_at(target + distance * away, target))


def shrink_camera(camera: observe.DepthCamera, factor: int) -> observe.DepthCamera:
    """Return the camera of images of which every ``factor``-th row and column is used."""
    K = camera.K / factor
    K[2, 2] = 1.0
    return replace(camera, width=camera.width // factor, height=camera.height // factor, K=K)


def build_room() -> list[Mesh]:
    """Return a wall behind the arms and the floor."""
    wall, floor = np.eye(4), np.eye(4)
    wall[0, 3], floor[2, 3] = WALL_X_M, FLOOR_Z_M
    return [
        observe.build_solid_mesh("box", (0.02, 6.0, 4.0), wall),
        observe.build_solid_mesh("box", (6.0, 6.0, 0.02), floor),
    ]
