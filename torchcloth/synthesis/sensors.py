"""The depth camera that looks on, across the table at the arms."""

from __future__ import annotations

import numpy as np

from ..observe import DepthCamera, DepthNoise, StereoNoise, View, look_at
from .episode_spec import Order

EYE, TARGET = (1.50, 0.45, 0.85), (0.52, 0.0, 0.20)  # m
POINTS = 600  # of the cloth, per frame at most
DEPTH_SCALE = 0.001  # m


def view(order: Order, rng: np.random.Generator) -> View:
    """The order's camera in its place, with the errors of one device."""
    place = look_at(np.array(EYE), np.array(TARGET))
    if order.camera == "d435":
        return View(DepthCamera.realsense_d435(place), StereoNoise(), points=POINTS).with_bias(rng)
    return View(DepthCamera.azure_kinect_nfov(place), DepthNoise(), points=POINTS).with_bias(rng)
