"""Depth images, a few of them decoded."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..observe import decode
from ..recordings import Camera

LOOKED_AT = 8


@dataclass(frozen=True)
class Depth:
    """A camera's depth images.

    Attributes:
        looked_at: how many were decoded, evenly chosen.
        invalid: share of their pixels without depth.
        near, middle, far: m, 5 %, 50 % and 95 % of the depths.
        distorted: whether the lens distorts.
    """

    looked_at: int
    invalid: float
    near: float
    middle: float
    far: float
    distorted: bool


def depth_of(camera: Camera) -> Depth | None:
    """A look at the depth images of a camera; None where it has none.

    Raises:
        RecordingError: an image that cannot be decoded.
        MissingDependency: Pillow is not installed.
    """
    if camera.depth is None or camera.depth_scale is None:
        return None
    chosen = np.unique(np.linspace(0, len(camera.depth) - 1, LOOKED_AT).astype(int))
    images = np.stack([decode(camera.depth.load(int(i)), camera.depth_scale) for i in chosen])
    seen = images[images > 0]
    near, middle, far = np.quantile(seen, [0.05, 0.5, 0.95]).tolist() if len(seen) else (np.nan,) * 3
    return Depth(len(chosen), 1 - len(seen) / images.size, near, middle, far, bool(np.any(camera.distortion)))
