"""Turns the objects of episode.json (and the cloth files it names) into the bags of `types`."""

from __future__ import annotations

import numpy as np

from ..errors import RecordingError
from . import checks, images, obj
from .checks import Fields
from .files import Folder
from .types import Camera, ClothInfo, Collider, GraspInfo, RobotInfo

HEAVIEST = 20.0  # kg/m^2; above this a density was given in g/m^2
THICKEST = 0.05  # m
WIDEST_GRASP = 1.0  # m


def cloth(fields: Fields, folder: Folder) -> ClothInfo:
    """Read the cloth; it needs a mesh or a sheet, and where both are given they must agree."""
    mesh, start = fields.maybe(fields.text, "mesh"), fields.maybe(fields.text, "initial_vertices")
    sheet = fields.inside("sheet")
    if mesh is None and not sheet.rest:
        raise RecordingError(
            f"{fields.place} has no shape", expected="mesh or sheet", remedy="name cloth.obj or a sheet"
        )
    vertices, faces, uv = (None, None, None) if mesh is None else _mesh(folder, mesh)
    return ClothInfo(
        areal_density=fields.number("areal_density", above=0, most=HEAVIEST, suspect="grams per square metre"),
        areal_density_std=fields.maybe(fields.number, "areal_density_std", least=0, most=HEAVIEST, suspect="g/m^2"),
        thickness=fields.maybe(fields.number, "thickness", above=0, most=THICKEST, suspect="millimetres"),
        sheet=_sheet(sheet) if sheet.rest else None,
        vertices=vertices,
        faces=faces,
        uv=uv,
        initial_vertices=None if start is None else _initial(folder, start, vertices),
        nominal=fields.inside("nominal").rest,
        extra=fields.left(sheet=sheet),
    )


def grasp(fields: Fields) -> GraspInfo:
    """Read one grasp."""
    radius = fields.number("radius", above=0, most=WIDEST_GRASP, suspect="millimetres")
    return GraspInfo(fields.array("uv", "G", 2), radius, fields.rest)


def robot(fields: Fields) -> RobotInfo:
    """Read one robot."""
    return RobotInfo(
        fields.text("model"), _transform(fields, "T_world_base"), fields.maybe(fields.text, "tool_frame"), fields.rest
    )


def collider(fields: Fields) -> Collider:
    """Read one collider; a shape that this version does not know is refused, for it would change the motion."""
    plane = fields.inside("plane")
    if not plane.rest:
        raise RecordingError(f"{fields.place} is of an unknown shape", got=sorted(fields.rest), expected="plane")
    point, normal = plane.array("point", 3), plane.array("normal", 3)
    checks.unit(normal, plane.at("normal"))
    return Collider(point, normal, fields.maybe(fields.number, "friction", least=0), fields.left(plane=plane))


def camera(fields: Fields, folder: Folder) -> Camera:
    """Read one camera and list its images; depth images need their scale."""
    size = fields.whole("width"), fields.whole("height")
    matrix = fields.array("K", 3, 3)
    if min(matrix[0, 0], matrix[1, 1]) <= 0 or not np.array_equal(matrix[2], [0, 0, 1]):
        got = matrix.tolist()
        raise RecordingError(
            f"{fields.at('K')} is no camera matrix", got=got, expected="[[fx, s, cx], [0, fy, cy], [0, 0, 1]]"
        )
    streams = images.find_streams(folder, size)
    if "depth" in streams and not fields.has("depth_scale"):
        raise RecordingError(
            f"{fields.at('depth_scale')} is missing", expected="metres per unit", remedy="0.001 for mm"
        )
    return Camera(
        width=size[0],
        height=size[1],
        K=matrix,
        T_world_camera=_transform(fields, "T_world_camera"),
        distortion=fields.array("distortion", "N") if fields.has("distortion") else np.zeros(0),
        depth_scale=fields.maybe(fields.number, "depth_scale", above=0, most=0.1, suspect="units per metre"),
        **streams,
        extra=fields.rest,
    )


def _sheet(fields: Fields) -> tuple[float, float]:
    width, height = (
        fields.number(key, above=0, most=checks.LARGEST_SCENE, suspect="millimetres") for key in ("width", "height")
    )
    return width, height


def _mesh(folder: Folder, file: str) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    vertices, faces, uv = obj.parse(folder.text(file), folder.place(file))
    checks.metres(vertices, f"{folder.place(file)}: v")
    if uv is not None:
        checks.metres(uv, f"{folder.place(file)}: vt")
    return vertices, faces, uv


def _initial(folder: Folder, file: str, vertices: np.ndarray | None) -> np.ndarray:
    place = folder.place(file)
    if vertices is None:
        raise RecordingError(
            f"{place} belongs to no mesh", expected="cloth.mesh in episode.json", remedy="write the mesh too"
        )
    initial = checks.array(folder.npy(file), place, (len(vertices), 3))
    checks.metres(initial, place)
    return initial


def _transform(fields: Fields, key: str) -> np.ndarray:
    matrix = fields.array(key, 4, 4)
    checks.transform(matrix, fields.at(key))
    return matrix
