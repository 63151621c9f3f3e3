"""A sensor at its place: what it reports of a cloth with occluders around it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ..errors import InvalidInput
from .camera import DepthCamera
from .cloud import erode, has_reading, thin_to_count, to_points
from .noise import AbstractNoise
from .render import render_depth

Array = np.ndarray
Mesh = tuple[Array, Array]


@dataclass(frozen=True, eq=False)
class View:
    """A depth camera with its errors, and how its images become points.

    Attributes:
        camera: the camera at its place.
        noise: its errors; None: an ideal sensor.
        mask_erosion: px, removed from the rim of the cloth's mask.
        max_points: largest number of points of a frame, drawn at random; None: all.
        bias: [..., H, W] the device's own error; draw it once per device by :meth:`with_bias`.
    """

    camera: DepthCamera
    noise: AbstractNoise | None = None
    mask_erosion: int = 2
    max_points: int | None = None
    bias: Array | None = None

    def with_bias(self, rng: np.random.Generator) -> View:
        """Return the same view through one device: with a bias drawn for it, if its noise has one."""
        if self.noise is None or not self.noise.has_bias:
            return self
        return replace(self, bias=self.noise.bias_field((self.camera.height, self.camera.width), rng))


class Capture(NamedTuple):
    """One frame.

    Attributes:
        depth: [H, W] float32 m, what the sensor reports of cloth and occluders; 0 = invalid.
        mask: [H, W] bool, the pixels that show the cloth, less their rim.
        points: [N, 3] m, world: the cloth's points.
    """

    depth: Array
    mask: Array
    points: Array


def capture(view: View, x: Array, faces: Array, occluders: Sequence[Mesh] = (), *, rng: np.random.Generator) -> Capture:
    """Compute what a view reports of a cloth.

    Args:
        view: camera, noise, and how points are made.
        x: [V, 3] m, the cloth's vertices in the world.
        faces: [F, 3], its triangles.
        occluders: vertices [V, 3] m and triangles [F, 3] of all else: robot (``build_solid_meshes``), table, walls.
        rng: source of the noise and of the points that are drawn.

    Raises:
        MissingDependency: open3d cannot be imported.
        InvalidInput: a mesh that cannot be rendered, or a noise that needs a bias (see :meth:`View.with_bias`).
    """
    clean, ids = render_depth(view.camera, [(x, faces), *occluders])
    mask = erode(ids == 0, view.mask_erosion)
    depth = clean if view.noise is None else view.noise.apply(clean, rng, view.bias)
    points = to_points(view.camera, depth, mask)
    return Capture(depth, mask, points if view.max_points is None else thin_to_count(points, view.max_points, rng))


def encode_depth(depth: Array, depth_scale: float = 0.001) -> Array:
    """Encode a depth image [H, W] m as a camera writes it: uint16 [H, W] in units of ``depth_scale`` m, 0 = invalid.

    A pixel without a reading (NaN) and a depth beyond the largest number become 0, which means invalid.

    Raises:
        InvalidInput: a scale that is not positive, or integers, which are not metres.
    """
    _check_scale(depth_scale)
    has_reading(np.asarray(depth))
    units = np.rint(np.nan_to_num(np.asarray(depth, dtype=float), posinf=0.0, neginf=0.0) / depth_scale)
    return np.where((units > 0) & (units <= np.iinfo(np.uint16).max), units, 0).astype(np.uint16)


def _check_scale(depth_scale: float) -> None:
    if not 0 < depth_scale < np.inf:
        raise InvalidInput("depth_scale", got=depth_scale, expected="a positive length in m per unit")


def decode_depth(image: Array, depth_scale: float = 0.001) -> Array:
    """Decode a stored image [H, W] in units of ``depth_scale`` m to depth [H, W] float32 m, 0 = invalid.

    Raises:
        InvalidInput: a scale that is not positive.
    """
    _check_scale(depth_scale)
    return (np.asarray(image) * np.float32(depth_scale)).astype(np.float32)
