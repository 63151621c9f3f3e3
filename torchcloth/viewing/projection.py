"""A film's frame as shaded polygons in an image, the farthest first."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..observe import DepthCamera, look_at
from .colours import colours
from .film import Film, Sheet, placed
from .geometry import Array, edges_of, face_normals, hems_of, soft_normals

FOCAL = 2.2  # image heights: a long lens, so that lengths can be compared
MARGIN = 0.06  # of the image, left free around what the film is about
ABOVE = 0.15  # m, shown of the arms above the grippers
TURN = 20.0  # degrees, by which the eye stands beside the recorded camera, or beside straight on
STRAIGHT = 1e-6  # rad from straight above or below, where up in the image is away from the eye's azimuth, or towards it
ELEVATIONS = (12.0, 55.0)  # degrees, of the eye above what it looks at
LIGHT = np.array([-0.3, -0.6, -0.75])  # direction to the light, in the camera's axes (x right, y down, z forward)
DOT = 0.0038  # of the image's height, radius of a point
BESIDE, ALONE = 1500, 8000  # points of a cloud that are drawn at most, with a cloth to be seen under them and without
IN_FRONT = 0.015  # of the scene's size, by which points come before the surface that they were measured on
NEAR = 0.05  # m, what is nearer to the camera is not drawn


class Light(NamedTuple):
    """How much shape darkens colours."""

    ambient: float  # share that comes from everywhere
    behind: float  # brightness of a back side


PLAIN, READABLE = Light(0.55, 0.82), Light(0.82, 1.0)  # the other where colours are read against a scale


class Polygons(NamedTuple):
    """N polygons of C corners each (some may coincide), sorted from far to near."""

    corners: Array  # [N, C, 2] pixels
    colours: Array  # [N, 3] sRGB, 0 to 1


def camera_for(film: Film, size: tuple[int, int], look: tuple[float, float] | None = None) -> DepthCamera:
    """A camera that sees all that the film is about, in every frame.

    Args:
        film: what to look at.
        size: (width, height) pixels.
        look: (azimuth, elevation) degrees of the eye, azimuth from x to y; None: from the side of the first recorded
            camera, else facing the arms.
    """
    width, height = size
    low, high = film.box
    arms = any(name.startswith("arms/") for name in film.solids)
    high = high + np.array([0, 0, ABOVE if arms else 0])
    corners = np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T
    azimuth, elevation = np.radians(_direction(film, (low + high) / 2) if look is None else look)
    towards = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    level = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    up = np.array([0.0, 0.0, 1.0]) if abs(np.cos(elevation)) > STRAIGHT else -np.sin(elevation) * level
    K = np.array([[FOCAL * height, 0, (width - 1) / 2], [0, FOCAL * height, (height - 1) / 2], [0, 0, 1]])
    half = (1 - 2 * MARGIN) * np.array([width, height]) / 2 / (FOCAL * height)
    target = (low + high) / 2
    for _ in range(4):  # the middle of the image depends on the distance, a little
        axes = look_at(target + towards, target, up)[:3, :3]
        local = (corners - target) @ axes
        distance = float((np.abs(local[:, :2]) / half - local[:, 2:]).max())
        seen = local[:, :2] / (local[:, 2:] + distance)
        target = target + axes[:, :2] @ ((seen.max(0) + seen.min(0)) / 2 * distance)
    return DepthCamera(width, height, K, look_at(target + distance * towards, target, up))


def _direction(film: Film, centre: Array) -> tuple[float, float]:
    """(azimuth, elevation) degrees of a good place for the eye."""
    for view in film.views.values():
        x, y, z = view.camera.T_world_camera[:3, 3] - centre
        elevation = np.clip(np.degrees(np.arctan2(z, np.hypot(x, y))), *ELEVATIONS)
        return float(np.degrees(np.arctan2(y, x))) + TURN, float(elevation)
    arms = [placed(solid, 0) for name, solid in film.solids.items() if name.startswith("arms/")]
    if arms:
        x, y, _ = centre - np.concatenate(arms).mean(0)
        return float(np.degrees(np.arctan2(y, x))) + TURN, 20.0
    return -60.0, 20.0


def ahead(points: Array, camera: DepthCamera, closed: bool = True) -> Array:
    """[M, 3] m, what lies before the camera of a convex polygon or a line [N, 3] m; where it is cut, it ends anew."""
    depth = (points - camera.T_world_camera[:3, 3]) @ camera.T_world_camera[:3, 2] - 2 * NEAR
    found = []
    for k in range(len(points)):
        if depth[k] >= 0:
            found.append(points[k])
        after = (k + 1) % len(points)
        if (closed or after) and (depth[k] >= 0) != (depth[after] >= 0):
            found.append(points[k] + depth[k] / (depth[k] - depth[after]) * (points[after] - points[k]))
    return np.array(found).reshape(-1, 3)


def polygons(film: Film, frame: int, camera: DepthCamera) -> Polygons:
    """Everything in a frame but planes and lines."""
    low, high = film.box
    reach = IN_FRONT * float(np.linalg.norm(high - low))
    parts = [
        _net(sheet, frame, reach, camera) if sheet.net else _sheet(sheet, frame, film.worst, camera)
        for sheet in film.sheets.values()
    ]
    for solid in film.solids.values():
        parts.append(_solid(placed(solid, frame), solid.faces, np.array(solid.colour), camera))
    most = BESIDE if film.sheets else ALONE
    parts += [_dots(_some(c.frames[frame], most), np.array(c.colour), reach, camera) for c in film.clouds.values()]
    if not film.solids:  # nothing else says where the grippers are
        held = [(trace.poses[frame, None, :3, 3], np.array(trace.colour)) for trace in film.traces.values()]
        parts += [_dots(place, colour, reach, camera, 2.5) for place, colour in held]
    if not parts:
        return Polygons(np.zeros((0, 4, 2)), np.zeros((0, 3)))
    corners, shades, depth = (np.concatenate(part) for part in zip(*parts, strict=True))
    order = np.argsort(-depth, kind="stable")
    return Polygons(corners[order], shades[order])


def _sheet(sheet: Sheet, frame: int, worst: float, camera: DepthCamera) -> tuple[Array, Array, Array]:
    x, faces = sheet.vertices[frame].astype(float), sheet.faces
    normals = soft_normals(x, faces)
    if sheet.values is None:
        return _shaded(x, faces, normals, np.array(sheet.colour), PLAIN, camera)
    colour = colours(sheet.values[frame], worst).astype(float)[faces].mean(1)
    return _shaded(x, faces, normals, colour, READABLE, camera)


def _net(sheet: Sheet, frame: int, reach: float, camera: DepthCamera) -> tuple[Array, Array, Array]:
    """Hems as polygons without area; where there are none, all edges."""
    pixels, depth = camera.project(sheet.vertices[frame].astype(float))
    edges = hems_of(sheet.faces)
    edges = edges if len(edges) else edges_of(sheet.faces)
    edges = edges[depth[edges].min(1) > NEAR]
    colour = np.broadcast_to(np.array(sheet.colour) / 255, (len(edges), 3))
    return pixels[edges][:, [0, 1, 1, 1]], colour, depth[edges].mean(1) - reach


def _solid(x: Array, faces: Array, colour: Array, camera: DepthCamera) -> tuple[Array, Array, Array]:
    normal = face_normals(x, faces)
    outside = ((camera.T_world_camera[:3, 3] - x[faces[:, 0]]) * normal).sum(-1) > 0
    faces, normal = faces[outside], normal[outside]
    return _shaded(x, faces, normal, colour, PLAIN, camera)


def _shaded(
    x: Array, faces: Array, normal: Array, colour: Array, paint: Light, camera: DepthCamera
) -> tuple[Array, Array, Array]:
    """Corners [F, 4, 2] px, colours [F, 3] and depths [F] m of the triangles that lie in front of the camera."""
    pixels, depth = camera.project(x)
    corner_depth = depth[faces]
    ahead = corner_depth.min(1) > NEAR
    faces, normal, colour = faces[ahead], normal[ahead], np.broadcast_to(colour, (len(ahead), 3))[ahead]
    towards = camera.T_world_camera[:3, 3] - x[faces].mean(1)
    back = (towards * face_normals(x, faces)).sum(-1) < 0
    normal = np.where(back[:, None], -normal, normal)
    light = camera.T_world_camera[:3, :3] @ (LIGHT / np.linalg.norm(LIGHT))
    bright = paint.ambient + (1 - paint.ambient) * np.clip(normal @ light, 0, 1)
    bright = np.where(back, paint.behind * bright, bright)
    corners = pixels[faces][:, [0, 1, 2, 2]]
    return corners, np.clip(colour / 255 * bright[:, None], 0, 1), corner_depth[ahead].mean(1)


def _some(points: Array, most: int) -> Array:
    """Points, left out evenly so that no more than ``most`` remain."""
    return points[:: max(1, -(-len(points) // most))]


def _dots(
    points: Array, colour: Array, reach: float, camera: DepthCamera, size: float = 1.0
) -> tuple[Array, Array, Array]:
    """Points as small diamonds."""
    pixels, depth = camera.project(points)
    pixels, depth = pixels[depth > NEAR], depth[depth > NEAR]
    shape = size * DOT * camera.height * np.array([[1.0, 0], [0, 1], [-1, 0], [0, -1]])
    return pixels[:, None] + shape, np.broadcast_to(colour / 255, (len(pixels), 3)), depth - reach
