"""Summarise a few decoded depth images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..observe import decode_depth
from ..recordings import Camera

DECODED_IMAGES = 8


@dataclass(frozen=True)
class DepthSummary:
    """Summary of a camera's depth images.

    Attributes:
        decoded_images: number of images that were decoded, evenly chosen.
        invalid_fraction: fraction of their pixels without depth.
        near, median, far: 5 %, 50 % and 95 % quantile of the depths [m].
        has_distortion: whether the lens has distortion.
    """

    decoded_images: int
    invalid_fraction: float
    near: float
    median: float
    far: float
    has_distortion: bool


def summarise_depth(camera: Camera) -> DepthSummary | None:
    """Summarise the depth images of a camera; None if it has none.

    Raises:
        RecordingError: an image cannot be decoded.
        MissingDependency: Pillow is not installed.
    """
    if camera.depth is None or camera.depth_scale is None:
        return None
    chosen = np.unique(np.linspace(0, len(camera.depth) - 1, DECODED_IMAGES).astype(int))
    images = np.stack([decode_depth(camera.depth.load(int(i)), camera.depth_scale) for i in chosen])
    valid = images[images > 0]
    near, middle, far = np.quantile(valid, [0.05, 0.5, 0.95]).tolist() if len(valid) else (np.nan,) * 3
    return DepthSummary(len(chosen), 1 - len(valid) / images.size, near, middle, far, bool(np.any(camera.distortion)))
