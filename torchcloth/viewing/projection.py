"""Project a film's frame to shaded polygons in an image, sorted from far to near."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..observe import DepthCamera, look_at
from .colours import map_colours
from .film import ClothSurface, Film, posed_vertices
from .geometry import Array, boundary_edges, face_normals, smoothed_normals, unique_edges

FOCAL_LENGTH_IMAGE_HEIGHTS = 2.2  # a long lens keeps lengths comparable
IMAGE_MARGIN_FRACTION = 0.06  # of the image, left free around the film's bounds
ARM_HEIGHT_SHOWN_M = 0.15  # of the arms above the grippers
AZIMUTH_OFFSET_DEG = 20.0  # of the eye from the recorded camera, or from the direction that faces the arms
VERTICAL_VIEW_TOLERANCE = 1e-6  # cosine of the elevation; below, the image's up direction follows the azimuth
ELEVATION_RANGE_DEG = (12.0, 55.0)  # of the eye
LIGHT_DIRECTION = np.array([-0.3, -0.6, -0.75])  # to the light, in camera axes (x right, y down, z forward)
POINT_RADIUS_IMAGE_HEIGHTS = 0.0038
MAX_POINTS_WITH_CLOTH = 1500  # drawn of a cloud, so that the cloth below stays visible
MAX_POINTS_ALONE = 8000  # drawn of a cloud without cloth
POINT_DEPTH_BIAS = 0.015  # of the scene's size, by which points come before the surface that they were measured on
NEAR_PLANE_M = 0.05  # nothing nearer to the camera is drawn


class Shading(NamedTuple):
    """Strength of the shading.

    Attributes:
        ambient: fraction of ambient light, 0 to 1.
        back_side: brightness of back sides relative to front sides, 0 to 1.
    """

    ambient: float
    back_side: float


PLAIN_SHADING = Shading(0.55, 0.82)
READABLE_SHADING = Shading(0.82, 1.0)  # for colours that are compared with a colour bar


class Polygons(NamedTuple):
    """N polygons of C corners each (some may coincide), sorted from far to near.

    Attributes:
        corners: [N, C, 2] pixels.
        colours: [N, 3] sRGB, 0 to 1.
    """

    corners: Array
    colours: Array


def fit_camera(film: Film, size: tuple[int, int], eye_direction_deg: tuple[float, float] | None = None) -> DepthCamera:
    """Return a camera whose image contains the film's bounds.

    Args:
        film: film whose bounds must fit into the image.
        size: (width, height) pixels.
        eye_direction_deg: (azimuth, elevation) of the eye [degrees], azimuth from x to y; None: from the side of the
            first recorded camera, else facing the arms.
    """
    width, height = size
    low, high = film.bounds
    arms = any(name.startswith("arms/") for name in film.solids)
    high = high + np.array([0, 0, ARM_HEIGHT_SHOWN_M if arms else 0])
    corners = np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T
    if eye_direction_deg is None:
        eye_direction_deg = _default_eye_direction(film, (low + high) / 2)
    azimuth, elevation = np.radians(eye_direction_deg)
    to_eye = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    level = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    up = np.array([0.0, 0.0, 1.0]) if abs(np.cos(elevation)) > VERTICAL_VIEW_TOLERANCE else -np.sin(elevation) * level
    K = np.array(
        [
            [FOCAL_LENGTH_IMAGE_HEIGHTS * height, 0, (width - 1) / 2],
            [0, FOCAL_LENGTH_IMAGE_HEIGHTS * height, (height - 1) / 2],
            [0, 0, 1],
        ]
    )
    half_size = (1 - 2 * IMAGE_MARGIN_FRACTION) * np.array([width, height]) / 2 / (FOCAL_LENGTH_IMAGE_HEIGHTS * height)
    target = (low + high) / 2
    for _ in range(4):  # the middle of the image depends slightly on the distance
        axes = look_at(target + to_eye, target, up)[:3, :3]
        local = (corners - target) @ axes
        distance = float((np.abs(local[:, :2]) / half_size - local[:, 2:]).max())
        seen = local[:, :2] / (local[:, 2:] + distance)
        target = target + axes[:, :2] @ ((seen.max(0) + seen.min(0)) / 2 * distance)
    return DepthCamera(width, height, K, look_at(target + distance * to_eye, target, up))


def _default_eye_direction(film: Film, centre: Array) -> tuple[float, float]:
    """Return the default (azimuth, elevation) [degrees] of the eye."""
    for view in film.views.values():
        x, y, z = view.camera.T_world_camera[:3, 3] - centre
        elevation = np.clip(np.degrees(np.arctan2(z, np.hypot(x, y))), *ELEVATION_RANGE_DEG)
        return float(np.degrees(np.arctan2(y, x))) + AZIMUTH_OFFSET_DEG, float(elevation)
    arms = [posed_vertices(solid, 0) for name, solid in film.solids.items() if name.startswith("arms/")]
    if arms:
        x, y, _ = centre - np.concatenate(arms).mean(0)
        return float(np.degrees(np.arctan2(y, x))) + AZIMUTH_OFFSET_DEG, 20.0
    return -60.0, 20.0


def clip_to_camera(points: Array, camera: DepthCamera, closed: bool = True) -> Array:
    """Return the part [M, 3] m of a convex polygon or polyline [N, 3] m that lies in front of the camera."""
    depth = (points - camera.T_world_camera[:3, 3]) @ camera.T_world_camera[:3, 2] - 2 * NEAR_PLANE_M
    clipped = []
    for k in range(len(points)):
        if depth[k] >= 0:
            clipped.append(points[k])
        after = (k + 1) % len(points)
        if (closed or after) and (depth[k] >= 0) != (depth[after] >= 0):
            clipped.append(points[k] + depth[k] / (depth[k] - depth[after]) * (points[after] - points[k]))
    return np.array(clipped).reshape(-1, 3)


def project_polygons(film: Film, frame: int, camera: DepthCamera) -> Polygons:
    """Project all shapes of a frame except planes and lines."""
    low, high = film.bounds
    depth_bias = POINT_DEPTH_BIAS * float(np.linalg.norm(high - low))
    parts = [
        _outline(sheet, frame, depth_bias, camera) if sheet.outline else _sheet(sheet, frame, film.colour_limit, camera)
        for sheet in film.sheets.values()
    ]
    for solid in film.solids.values():
        parts.append(_solid(posed_vertices(solid, frame), solid.faces, np.array(solid.colour), camera))
    max_points = MAX_POINTS_WITH_CLOTH if film.sheets else MAX_POINTS_ALONE
    parts += [
        _dots(_thin_out(c.frames[frame], max_points), np.array(c.colour), depth_bias, camera)
        for c in film.clouds.values()
    ]
    if not film.solids:  # nothing else shows the grippers
        grippers = [(trace.poses[frame, None, :3, 3], np.array(trace.colour)) for trace in film.traces.values()]
        parts += [_dots(place, colour, depth_bias, camera, 2.5) for place, colour in grippers]
    if not parts:
        return Polygons(np.zeros((0, 4, 2)), np.zeros((0, 3)))
    corners, shades, depth = (np.concatenate(part) for part in zip(*parts, strict=True))
    order = np.argsort(-depth, kind="stable")
    return Polygons(corners[order], shades[order])


def _sheet(sheet: ClothSurface, frame: int, colour_limit: float, camera: DepthCamera) -> tuple[Array, Array, Array]:
    """Return corners [F, 4, 2] px, colours [F, 3] and depths [F] m of a sheet's triangles, coloured by its values."""
    x, faces = sheet.vertices[frame].astype(float), sheet.faces
    normals = smoothed_normals(x, faces)
    if sheet.values is None:
        return _shaded(x, faces, normals, np.array(sheet.colour), PLAIN_SHADING, camera)
    colour = map_colours(sheet.values[frame], colour_limit).astype(float)[faces].mean(1)
    return _shaded(x, faces, normals, colour, READABLE_SHADING, camera)


def _outline(sheet: ClothSurface, frame: int, depth_bias: float, camera: DepthCamera) -> tuple[Array, Array, Array]:
    """Return corners [E, 4, 2] px, colours [E, 3] and depths [E] m of the boundary edges, as polygons without area.

    A sheet without a boundary shows all its edges.
    """
    pixels, depth = camera.project(sheet.vertices[frame].astype(float))
    edges = boundary_edges(sheet.faces)
    edges = edges if len(edges) else unique_edges(sheet.faces)
    edges = edges[depth[edges].min(1) > NEAR_PLANE_M]
    colour = np.broadcast_to(np.array(sheet.colour) / 255, (len(edges), 3))
    return pixels[edges][:, [0, 1, 1, 1]], colour, depth[edges].mean(1) - depth_bias


def _solid(x: Array, faces: Array, colour: Array, camera: DepthCamera) -> tuple[Array, Array, Array]:
    """Return corners [F, 4, 2] px, colours [F, 3] and depths [F] m of a solid's triangles that face the camera."""
    normal = face_normals(x, faces)
    outside = ((camera.T_world_camera[:3, 3] - x[faces[:, 0]]) * normal).sum(-1) > 0
    faces, normal = faces[outside], normal[outside]
    return _shaded(x, faces, normal, colour, PLAIN_SHADING, camera)


def _shaded(
    x: Array, faces: Array, normal: Array, colour: Array, shading: Shading, camera: DepthCamera
) -> tuple[Array, Array, Array]:
    """Return corners [F, 4, 2] px, colours [F, 3] and depths [F] m of the triangles in front of the camera."""
    pixels, depth = camera.project(x)
    corner_depth = depth[faces]
    is_in_front = corner_depth.min(1) > NEAR_PLANE_M
    colour = np.broadcast_to(colour, (len(faces), 3))[is_in_front]
    faces, normal = faces[is_in_front], normal[is_in_front]
    to_eye = camera.T_world_camera[:3, 3] - x[faces].mean(1)
    is_back_side = (to_eye * face_normals(x, faces)).sum(-1) < 0
    normal = np.where(is_back_side[:, None], -normal, normal)
    light = camera.T_world_camera[:3, :3] @ (LIGHT_DIRECTION / np.linalg.norm(LIGHT_DIRECTION))
    brightness = shading.ambient + (1 - shading.ambient) * np.clip(normal @ light, 0, 1)
    brightness = np.where(is_back_side, shading.back_side * brightness, brightness)
    corners = pixels[faces][:, [0, 1, 2, 2]]
    return corners, np.clip(colour / 255 * brightness[:, None], 0, 1), corner_depth[is_in_front].mean(1)


def _thin_out(points: Array, max_points: int) -> Array:
    """Return at most ``max_points`` of the points, evenly chosen."""
    return points[:: max(1, -(-len(points) // max_points))]


def _dots(
    points: Array, colour: Array, depth_bias: float, camera: DepthCamera, size: float = 1.0
) -> tuple[Array, Array, Array]:
    """Return corners [N, 4, 2] px, colours [N, 3] and depths [N] m of points, drawn as small diamonds."""
    pixels, depth = camera.project(points)
    pixels, depth = pixels[depth > NEAR_PLANE_M], depth[depth > NEAR_PLANE_M]
    shape = size * POINT_RADIUS_IMAGE_HEIGHTS * camera.height * np.array([[1.0, 0], [0, 1], [-1, 0], [0, -1]])
    return pixels[:, None] + shape, np.broadcast_to(colour / 255, (len(pixels), 3)), depth - depth_bias
