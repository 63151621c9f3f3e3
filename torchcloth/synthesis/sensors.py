"""Depth camera that looks across the table at the arms."""

from __future__ import annotations

import numpy as np

from ..observe import DepthCamera, DepthNoise, StereoNoise, View, look_at
from .episode_spec import EpisodeSpec

CAMERA_POSITION_M, CAMERA_TARGET_M = (1.50, 0.45, 0.85), (0.52, 0.0, 0.20)
POINTS_PER_FRAME = 600  # of the cloth, at most
DEPTH_SCALE_M = 0.001


def build_view(spec: EpisodeSpec, rng: np.random.Generator) -> View:
    """Build the specified camera at its place, with the errors of one device."""
    pose = look_at(np.array(CAMERA_POSITION_M), np.array(CAMERA_TARGET_M))
    if spec.camera == "d435":
        return View(DepthCamera.realsense_d435(pose), StereoNoise(), max_points=POINTS_PER_FRAME).with_bias(rng)
    return View(DepthCamera.azure_kinect_nfov(pose), DepthNoise(), max_points=POINTS_PER_FRAME).with_bias(rng)
