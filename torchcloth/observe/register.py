"""Registration of one camera's images to another: distortion removed, depth laid onto colour, colours for points."""

from __future__ import annotations

import numpy as np

from ..errors import InvalidInput
from .camera import DepthCamera
from .cloud import has_reading
from .noise import mask_depth_edges
from .render import render_depth

Array = np.ndarray
MAX_POINT_DEPTH_M = 0.02  # a point that is farther behind the registered depth is hidden


def reproject(depth: Array, source: DepthCamera, target: DepthCamera, edge: float = 0.02) -> Array:
    """Compute the depth image [H, W] m that ``target`` would have taken, 0 = invalid.

    Neighbouring pixels of the source span triangles, which the target sees by ray casting. There are no holes if the
    target has the finer pixels, and what is hidden from it stays hidden. ``reproject(depth, camera,
    camera.without_distortion())`` removes the lens distortion. With the colour camera as target it registers depth to
    colour.

    Args:
        depth: [H, W] m, 0 = invalid, of the source.
        source: camera that took the image, with its lens and pose.
        target: camera to compute the image for, with its lens and pose.
        edge: m, larger steps between neighbours are edges, not surface.

    Raises:
        MissingDependency: open3d cannot be imported.
        InvalidInput: an image that has not the source's size.
    """
    depth = np.asarray(depth)
    if depth.shape != (source.height, source.width):
        raise InvalidInput("depth", got=f"shape {depth.shape}", expected=f"{(source.height, source.width)}, the source")
    good = has_reading(depth) & np.isfinite(source.pixel_rays[..., 0])
    index = np.where(good, np.cumsum(good).reshape(good.shape) - 1, -1)
    rows, columns = np.nonzero(good)
    vertices = source.unproject_pixels(rows, columns, depth[good])
    a, b, c, d = (index[i, j].ravel() for i in (slice(-1), slice(1, None)) for j in (slice(-1), slice(1, None)))
    faces = np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, d], 1)])
    faces = faces[(faces >= 0).all(1)]
    steps = np.ptp(depth[good][faces], axis=1)
    return render_depth(target, [(vertices, faces[steps <= edge])])[0]


def sample_colors(points: Array, color: Array, camera: DepthCamera, depth: Array | None = None) -> tuple[Array, Array]:
    """Return colours [N, 3] uint8 of world points [N, 3] m, and which of them [N] the colour camera sees.

    Args:
        points: [N, 3] m.
        color: [H, W, 3] uint8.
        camera: that took the colour image.
        depth: [H, W] m, registered to the colour camera (``reproject``); a point more than 2 cm behind it is hidden. A
            pixel without a reading, 0 or NaN, hides nothing. None: no point is hidden.

    Raises:
        InvalidInput: images that have not the camera's size, or colours beyond 0 to 255.
    """
    if np.shape(color) != (camera.height, camera.width, 3):
        raise InvalidInput("color", got=f"shape {np.shape(color)}", expected=f"{(camera.height, camera.width, 3)}")
    check_uint8("color", np.asarray(color))
    if depth is not None and np.shape(depth) != (camera.height, camera.width):
        expected = f"{(camera.height, camera.width)}, registered to the colour camera (reproject)"
        raise InvalidInput("depth", got=f"shape {np.shape(depth)}", expected=expected)
    pixels, z = camera.project(points)
    with np.errstate(invalid="ignore"):
        inside = (z > 0) & ((pixels > -0.5) & (pixels < [camera.width - 0.5, camera.height - 0.5])).all(-1)
    columns, rows = np.rint(np.where(inside[:, None], pixels, 0)).astype(int).T
    if depth is not None:
        front = np.asarray(depth)[rows, columns]
        inside &= ~has_reading(front) | (z < front + MAX_POINT_DEPTH_M)
    return np.where(inside[:, None], np.asarray(color)[rows, columns], 0).astype(np.uint8), inside


def check_uint8(what: str, colors: Array) -> None:
    """Refuse colours that are not integers from 0 to 255.

    Raises:
        InvalidInput: fractions, or 16 bits.
    """
    if colors.dtype.kind not in "iu":
        remedy = "from 0 to 1: multiply by 255 and convert"
        raise InvalidInput(what, got=colors.dtype, expected="uint8, 0 to 255", remedy=remedy)
    if not 0 <= colors.min(initial=0) <= colors.max(initial=0) <= 255:
        got, remedy = f"{colors.min()} to {colors.max()}", "divide by 257 what has 16 bits"
        raise InvalidInput(what, got=got, expected="uint8, 0 to 255", remedy=remedy)


def mask_steep_pixels(depth: Array, edge: float) -> Array:
    """Return the pixels [H, W] whose 3 x 3 neighbourhood spans more than ``edge`` m.

    These are edges, where pixels fly, and surfaces at a grazing angle, which a sensor measures badly.
    """
    return has_reading(np.asarray(depth)) & mask_depth_edges(np.asarray(depth), edge)
