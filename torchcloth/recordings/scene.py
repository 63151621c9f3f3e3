"""Turns the objects of episode.json (and the cloth files it names) into the bags of `types`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ..errors import InvalidInput, RecordingError
from ..meshes import obj
from ..meshes.mesh import HEAVIEST, check_metres, per_vertex
from . import checks
from .checks import Fields
from .files import Folder
from .images import ImageStream, Kind
from .types import Camera, ClothInfo, Collider, GraspInfo, RobotInfo

THICKEST, THICKNESS = 0.05, 1e-3  # m; the second where nothing is said
FRICTION = 0.4  # of a table, where nothing is said
WIDEST_GRASP = 1.0  # m
NOMINAL: dict[str, dict[str, Any]] = {  # bounds; far above every fabric, where a number is in another unit
    "membrane_stiffness": {"above": 0, "most": 1e9, "suspect": "another unit"},
    "youngs_modulus": {"above": 0, "most": 1e13, "suspect": "another unit"},
    "poisson_ratio": {"above": 0, "most": 0.499999, "suspect": "another measure"},
    "bending_stiffness": {"least": 0, "most": 1.0, "suspect": "micronewton metres"},
    "bending_damping_time": {"least": 0, "most": 100.0, "suspect": "milliseconds"},
}
SHAPES = {"box", "capsule", "cylinder", "mesh", "sphere"}  # of colliders that are not built
NOTE = "units"  # of the data sheet, for people
DISTORTIONS = (0, 4, 5, 8, 12, 14)  # coefficients in OpenCV's order: a calibration has no other number of them


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
        **fabric(fields),
        sheet=_sheet(sheet) if sheet.rest else None,
        vertices=vertices,
        faces=faces,
        uv=uv,
        initial_vertices=None if start is None else _initial(folder, start, vertices),
        extra=fields.left(sheet=sheet),
    )


def fabric(fields: Fields) -> dict[str, Any]:
    """What is known of a cloth beside its shape, as `ClothInfo` names it."""
    found = {
        "areal_density": fields.number("areal_density", above=0, most=HEAVIEST, suspect="grams per square metre"),
        "areal_density_std": fields.maybe(fields.number, "areal_density_std", least=0, most=HEAVIEST, suspect="g/m^2"),
        "thickness": fields.maybe(fields.number, "thickness", above=0, most=THICKEST, suspect="millimetres"),
        "nominal": _nominal(fields.inside("nominal")),
    }
    _check_stiffness(found["nominal"], found["thickness"] or THICKNESS, fields.at("nominal"))
    return found


def grasp(fields: Fields) -> GraspInfo:
    """Read one grasp: pattern points with a radius, or vertices."""
    if fields.has("vertices"):
        if fields.has("uv"):
            raise RecordingError(f"{fields.place} holds twice", got="uv and vertices", expected="one of them")
        return GraspInfo(vertices=fields.array("vertices", "N", kind="int"), extra=fields.left())
    radius = fields.number("radius", above=0, most=WIDEST_GRASP, suspect="millimetres")
    return GraspInfo(fields.array("uv", "G", 2), radius, fields.left())


def robot(fields: Fields) -> RobotInfo:
    """Read one robot."""
    model, base = fields.text("model"), _transform(fields, "T_world_base")
    return RobotInfo(model, base, fields.maybe(fields.text, "tool_frame"), fields.left())


def collider(fields: Fields) -> Collider:
    """Read one collider; a shape that this version does not know is refused, for it would change the motion."""
    plane = fields.inside("plane")
    if not plane.rest or SHAPES & fields.rest.keys():
        got = [*(["plane"] if plane.rest else []), *sorted(fields.rest)]
        raise RecordingError(f"{fields.place} is of an unknown shape", got=got, expected="plane")
    point, normal = plane.array("point", 3), checks.unit(plane.array("normal", 3), plane.at("normal"))
    return Collider(point, normal, fields.maybe(fields.number, "friction", least=0), fields.left(plane=plane))


def camera(fields: Fields, images_of: Callable[[tuple[int, int]], dict[Kind, ImageStream]]) -> Camera:
    """Read one camera and list its images, which ``images_of`` finds for (width, height); depth needs its scale."""
    size = fields.whole("width"), fields.whole("height")
    matrix = fields.array("K", 3, 3)
    if min(matrix[0, 0], matrix[1, 1]) <= 0 or not np.array_equal(matrix[[1, 2, 2, 2], [0, 0, 1, 2]], [0, 0, 0, 1]):
        got = matrix.tolist()
        raise RecordingError(
            f"{fields.at('K')} is no camera matrix", got=got, expected="[[fx, s, cx], [0, fy, cy], [0, 0, 1]]"
        )
    streams = images_of(size)
    if "depth" in streams and not fields.has("depth_scale"):
        raise RecordingError(
            f"{fields.at('depth_scale')} is missing", expected="metres per unit", remedy="0.001 for mm"
        )
    return Camera(
        width=size[0],
        height=size[1],
        K=matrix,
        T_world_camera=_transform(fields, "T_world_camera"),
        distortion=_distortion(fields),
        depth_scale=fields.maybe(fields.number, "depth_scale", above=0, most=0.1, suspect="units per metre"),
        **streams,
        extra=fields.left(),
    )


def _distortion(fields: Fields) -> np.ndarray:
    found = fields.array("distortion", "N") if fields.has("distortion") else np.zeros(0)
    if len(found) not in DISTORTIONS:
        raise RecordingError(
            f"{fields.at('distortion')} is cut off",
            got=f"{len(found)} numbers",
            expected="0, 4, 5, 8, 12 or 14 in OpenCV's order k1 k2 p1 p2 k3 k4 k5 k6 s1..s4 tx ty",
            remedy="append the zeros that were left out",
        )
    return found


def _sheet(fields: Fields) -> tuple[float, float]:
    width, height = (
        fields.number(key, above=0, most=checks.LARGEST_SCENE, suspect="millimetres") for key in ("width", "height")
    )
    return width, height


def _mesh(folder: Folder, file: str) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Vertices, faces, and pattern coordinates per vertex, or per corner where panels are sewn."""
    try:
        vertices, faces, corners = obj.parse(folder.text(file), folder.place(file))
        checks.metres(vertices, f"{folder.place(file)}: v")
        if corners is None:
            return vertices, faces, None
        checks.metres(corners, f"{folder.place(file)}: vt")
        check_metres(vertices, faces, corners, folder.place(file))
    except InvalidInput as error:
        raise RecordingError(error.what, got=error.got, expected=error.expected, remedy=error.remedy) from error
    uv = per_vertex(faces, corners)
    return vertices, faces, corners if uv is None else uv


def _initial(folder: Folder, file: str, vertices: np.ndarray | None) -> np.ndarray:
    place = folder.place(file)
    initial = folder.npy(file)
    if vertices is not None:
        initial = checks.array(initial, place, (len(vertices), 3))
    elif initial.ndim == 3 and min(initial.shape[:2]) > 1:
        initial = checks.array(initial, place, ("M", "N", 3))
    else:
        raise RecordingError(
            f"{place} belongs to no mesh",
            got=list(initial.shape),
            expected="[M, N, 3], a grid on the sheet, or cloth.mesh in episode.json",
            remedy="write the mesh too",
        )
    checks.metres(initial, place)
    return initial


def _nominal(fields: Fields) -> dict[str, Any]:
    """Data-sheet values by name; an unknown one is refused, for a misspelt one would be ignored."""
    found = {}
    for key, value in list(fields.rest.items()):
        if key not in (*NOMINAL, NOTE):
            expected = f"one of {', '.join((*NOMINAL, NOTE))}"
            raise RecordingError(f"{fields.at(key)} is unknown", expected=expected, remedy="correct its spelling")
        if value is not None:
            if key != NOTE:
                fields.number(key, **NOMINAL[key])
            found[key] = value  # as it is written, so that it is written so again
    return found


def _check_stiffness(nominal: dict[str, Any], thickness: float, place: str) -> None:
    """Of a membrane that is told twice both must agree: one of them would be ignored."""
    if {"membrane_stiffness", "youngs_modulus"} <= nominal.keys():
        told, follows = nominal["membrane_stiffness"], nominal["youngs_modulus"] * thickness
        if not np.isclose(told, follows, rtol=0.01):
            raise RecordingError(
                f"{place}.membrane_stiffness is not youngs_modulus times thickness",
                got=f"{told:g} N/m",
                expected=f"{follows:g} N/m",
                remedy="correct one of them, or leave it out",
            )


def _transform(fields: Fields, key: str) -> np.ndarray:
    return checks.transform(fields.array(key, 4, 4), fields.at(key))
