"""From depth images and masks to points in the world, and down to as many points as a fit needs."""

from __future__ import annotations

import numpy as np

from ..errors import InvalidInput
from .camera import DepthCamera

Array = np.ndarray


def to_points(camera: DepthCamera, depth: Array, mask: Array | None = None) -> Array:
    """World points [N, 3] m of the pixels that have a depth, a ray and lie in the mask, row by row.

    Args:
        camera: the camera that took the image.
        depth: [H, W] m, 0 = invalid.
        mask: [H, W] bool, the pixels wanted; None wants all.

    Raises:
        InvalidInput: an image that has not the camera's size.
    """
    depth = np.asarray(depth)
    shape = (camera.height, camera.width)
    for name, image in (("depth", depth), ("mask", mask)):
        if image is not None and np.shape(image) != shape:
            raise InvalidInput(name, got=f"shape {np.shape(image)}", expected=f"{shape}, the camera's size")
    wanted = has_reading(depth) if mask is None else has_reading(depth) & np.asarray(mask, bool)
    rows, columns = np.nonzero(wanted & np.isfinite(camera.grid[..., 0]))
    return camera.at_pixels(rows, columns, depth[rows, columns])


def has_reading(depth: Array) -> Array:
    """Pixels [H, W] whose depth says where something is: ROS writes NaN for none and infinity for too far (REP 118).

    Raises:
        InvalidInput: whole numbers, which are no metres.
    """
    if depth.dtype.kind in "iu":
        remedy = "a camera's file is in other units: times metres per unit, 0.001 for millimetres"
        raise InvalidInput("depth", got=f"whole numbers ({depth.dtype})", expected="metres", remedy=remedy)
    return (depth > 0) & (depth < np.inf)


def erode(mask: Array, pixels: int = 1) -> Array:
    """The mask [H, W] without its rim of ``pixels``, as a segmentation leaves out the unsure border; the image's
    border is no rim.
    """
    mask = np.asarray(mask, bool)
    for _ in range(pixels):
        padded = np.pad(mask, 1, constant_values=True)
        mask = padded[1:-1, 1:-1] & padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
    return mask


def thin_to_count(points: Array, count: int, rng: np.random.Generator) -> Array:
    """At most ``count`` of the points [N, 3], drawn at random without repetition, in their old order.

    They are measured points: nothing is averaged, the noise of each stays what it was.
    """
    if count < 1:
        raise InvalidInput("count", got=count, expected="at least 1 point")
    if len(points) <= count:
        return points
    return points[np.sort(rng.choice(len(points), count, replace=False))]


def thin_to_spacing(points: Array, spacing: float) -> Array:
    """One measured point of each occupied cube of edge ``spacing`` m: the one nearest to the mean of the cube's points.

    The mean itself would have less noise than the camera; a measured point has the camera's own (a little less, as
    outliers are seldom nearest to the mean).

    Args:
        points: [N, 3] m; those that are not finite are in no cube.
        spacing: m.
    """
    return np.asarray(points, dtype=float)[spaced(points, spacing)]


def spaced(points: Array, spacing: float) -> Array:
    """Indices, in order, of the points that `thin_to_spacing` keeps."""
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
