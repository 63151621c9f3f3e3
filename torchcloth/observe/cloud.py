"""World points from depth images and masks, and the thinning of clouds."""

from __future__ import annotations

import numpy as np

from ..errors import InvalidInput
from .camera import DepthCamera

Array = np.ndarray


def to_points(camera: DepthCamera, depth: Array, mask: Array | None = None) -> Array:
    """Compute world points [N, 3] m of the pixels that have a depth and a ray and lie in the mask, row by row.

    Args:
        camera: that took the image.
        depth: [H, W] m, 0 = invalid.
        mask: [H, W] bool, pixels to use; None: all.

    Raises:
        InvalidInput: an image that has not the camera's size.
    """
    depth = np.asarray(depth)
    shape = (camera.height, camera.width)
    for name, image in (("depth", depth), ("mask", mask)):
        if image is not None and np.shape(image) != shape:
            raise InvalidInput(name, got=f"shape {np.shape(image)}", expected=f"{shape}, the camera's size")
    wanted = has_reading(depth) if mask is None else has_reading(depth) & np.asarray(mask, bool)
    rows, columns = np.nonzero(wanted & np.isfinite(camera.pixel_rays[..., 0]))
    return camera.unproject_pixels(rows, columns, depth[rows, columns])


def has_reading(depth: Array) -> Array:
    """Return which pixels [H, W] have a valid depth; ROS writes NaN for none and infinity for too far (REP 118).

    Raises:
        InvalidInput: integers, which are not metres.
    """
    if depth.dtype.kind in "iu":
        remedy = "a camera's file is in other units: times metres per unit, 0.001 for millimetres"
        raise InvalidInput("depth", got=f"whole numbers ({depth.dtype})", expected="metres", remedy=remedy)
    return (depth > 0) & (depth < np.inf)


def erode(mask: Array, pixels: int = 1) -> Array:
    """Return the mask [H, W] without a rim of ``pixels`` px, where a segmentation is uncertain.

    The border of the image is no rim.
    """
    mask = np.asarray(mask, bool)
    for _ in range(pixels):
        padded = np.pad(mask, 1, constant_values=True)
        mask = padded[1:-1, 1:-1] & padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
    return mask


def thin_to_count(points: Array, count: int, rng: np.random.Generator) -> Array:
    """Draw at most ``count`` of the points [N, 3] at random without repetition, and keep their order.

    These are measured points: nothing is averaged, so the noise of each point does not change.
    """
    if count < 1:
        raise InvalidInput("count", got=count, expected="at least 1 point")
    if len(points) <= count:
        return points
    return points[np.sort(rng.choice(len(points), count, replace=False))]


def thin_to_spacing(points: Array, spacing: float) -> Array:
    """Return one measured point of each occupied cube: the one nearest to the mean of the cube's points.

    The mean itself would have less noise than the camera. A measured point has the camera's own noise (a little less,
    as outliers are seldom nearest to the mean).

    Args:
        points: [N, 3] m; points that are not finite are in no cube.
        spacing: m, edge of the cubes.
    """
    return np.asarray(points, dtype=float)[select_by_spacing(points, spacing)]


def select_by_spacing(points: Array, spacing: float) -> Array:
    """Return the indices, in order, of the points that ``thin_to_spacing`` selects."""
    points = np.asarray(points, dtype=float)
    if not spacing > 0:
        raise InvalidInput("spacing", got=spacing, expected="a positive length in m")
    known = np.flatnonzero(np.isfinite(points).all(1))
    if len(known) == 0:
        return known
    points = points[known]
    _, cell = np.unique(np.floor(points / spacing).astype(np.int64), axis=0, return_inverse=True)
    cell = cell.ravel()
    counts = np.bincount(cell)
    mean = np.stack([np.bincount(cell, points[:, k]) for k in range(3)], 1) / counts[:, None]
    distance = ((points - mean[cell]) ** 2).sum(1)
    order = np.lexsort((np.arange(len(points)), distance, cell))
    first = np.concatenate([[0], np.cumsum(counts)[:-1]])
    return known[np.sort(order[first])]
