"""Conversion of the objects of episode.json, and of the cloth files that it names, to the data classes of ``types``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ..errors import InvalidInput, RecordingError
from ..meshes import obj
from ..meshes.mesh import MAX_AREAL_DENSITY_KG_PER_M2, check_metres, corner_to_vertex_values
from . import checks
from .camera_checks import check_matrix_fits_images
from .checks import Fields
from .files import Folder
from .images import ImageKind, ImageStream
from .initial_shape import check_initial_shape
from .types import Camera, ClothInfo, Collider, GraspInfo, RobotInfo

MAX_THICKNESS_M = 0.05
MAX_LAYER_GAP_M = 0.2
DEFAULT_THICKNESS_M = 1e-3  # if the episode gives none
DEFAULT_TABLE_FRICTION = 0.4  # if the episode gives none
MAX_GRASP_RADIUS_M = 1.0
MAX_INITIAL_SPEED_M_PER_S = 50.0
MAX_DEPTH_SCALE_M = 0.1  # per unit of a depth image
NOMINAL_BOUNDS: dict[str, dict[str, Any]] = {  # bounds; far above every fabric, where a number is in another unit
    "membrane_stiffness": {"above": 0, "maximum": 1e9, "suspect": "another unit"},
    "youngs_modulus": {"above": 0, "maximum": 1e13, "suspect": "another unit"},
    "poisson_ratio": {"above": 0, "maximum": 0.499999, "suspect": "another measure"},
    "bending_stiffness": {"minimum": 0, "maximum": 1.0, "suspect": "micronewton metres"},
    "bending_damping_time": {"minimum": 0, "maximum": 100.0, "suspect": "milliseconds"},
    "contact_stiffness": {"above": 0, "maximum": 1e13, "suspect": "another unit"},
    "shear_stiffness": {"above": 0, "maximum": 1e13, "suspect": "another unit"},
    "cone": {"minimum": 0, "maximum": 100.0, "suspect": "an angle"},
}
UNSUPPORTED_COLLIDER_SHAPES = {"box", "capsule", "cylinder", "mesh", "sphere"}  # of colliders that are not built
NOMINAL_UNITS_KEY = "units"  # of the data sheet, for people
DISTORTION_COUNTS = (0, 4, 5, 8, 12, 14)  # coefficients in OpenCV's order: a calibration has no other number of them


def read_cloth(fields: Fields, folder: Folder) -> ClothInfo:
    """Read the cloth; it needs a mesh or a sheet, and if both are given they must agree."""
    mesh, start = fields.optional(fields.text, "mesh"), fields.optional(fields.text, "initial_vertices")
    velocities = fields.optional(fields.text, "initial_velocities")
    has_sheet, sheet = fields.has("sheet"), fields.group("sheet")
    if mesh is None and not has_sheet:
        raise RecordingError(
            f"{fields.place} has no shape", expected="mesh or sheet", remedy="name cloth.obj or a sheet"
        )
    vertices, faces, uv = (None, None, None) if mesh is None else _mesh(folder, mesh)
    cloth = ClothInfo(
        **read_fabric(fields),
        sheet=_sheet(sheet) if has_sheet else None,
        vertices=vertices,
        faces=faces,
        uv=uv,
        initial_vertices=None if start is None else _initial(folder, start, vertices),
        initial_velocities=None if velocities is None else _velocities(folder, velocities, start, vertices),
        extra=fields.unknown_keys(sheet=sheet),
    )
    check_initial_shape(cloth, folder.location(start or ""))
    return cloth


def read_fabric(fields: Fields) -> dict[str, Any]:
    """Read the properties of a cloth besides its shape, by the names of ``ClothInfo``."""
    values = {
        "areal_density": fields.number(
            "areal_density", above=0, maximum=MAX_AREAL_DENSITY_KG_PER_M2, suspect="grams per square metre"
        ),
        "areal_density_std": fields.optional(
            fields.number, "areal_density_std", minimum=0, maximum=MAX_AREAL_DENSITY_KG_PER_M2, suspect="g/m^2"
        ),
        "thickness": fields.optional(
            fields.number, "thickness", above=0, maximum=MAX_THICKNESS_M, suspect="millimetres"
        ),
        "layer_gap": fields.optional(
            fields.number, "layer_gap", above=0, maximum=MAX_LAYER_GAP_M, suspect="millimetres"
        ),
        "nominal": _nominal(fields.group("nominal")),
    }
    _check_stiffness(values["nominal"], values["thickness"] or DEFAULT_THICKNESS_M, fields.location("nominal"))
    return values


def read_grasp(fields: Fields) -> GraspInfo:
    """Read one grasp: pattern points with a radius, or vertices."""
    if fields.has("vertices"):
        if fields.has("uv"):
            raise RecordingError(f"{fields.place} holds twice", got="uv and vertices", expected="one of them")
        return GraspInfo(vertices=fields.array("vertices", "N", kind="int"), extra=fields.unknown_keys())
    radius = fields.number("radius", above=0, maximum=MAX_GRASP_RADIUS_M, suspect="millimetres")
    return GraspInfo(fields.array("uv", "G", 2), radius, fields.unknown_keys())


def read_robot(fields: Fields) -> RobotInfo:
    """Read one entry of ``robots``."""
    model, base = fields.text("model"), _transform(fields, "T_world_base")
    return RobotInfo(model, base, fields.optional(fields.text, "tool_frame"), fields.unknown_keys())


def read_collider(fields: Fields) -> Collider:
    """Read one collider; an unsupported shape is refused, for it would change the motion."""
    plane = fields.group("plane")
    if not plane.remaining or UNSUPPORTED_COLLIDER_SHAPES & fields.remaining.keys():
        got = [*(["plane"] if plane.remaining else []), *sorted(fields.remaining)]
        raise RecordingError(f"{fields.place} is of an unknown shape", got=got, expected="plane")
    point, normal = plane.array("point", 3), checks.normalise_unit(plane.array("normal", 3), plane.location("normal"))
    return Collider(
        point, normal, fields.optional(fields.number, "friction", minimum=0), fields.unknown_keys(plane=plane)
    )


def read_camera(fields: Fields, images_of: Callable[[tuple[int, int]], dict[ImageKind, ImageStream]]) -> Camera:
    """Read one camera and list its images, which ``images_of`` gives for (width, height); depth needs its scale."""
    size = fields.whole_number("width"), fields.whole_number("height")
    matrix = fields.array("K", 3, 3)
    if min(matrix[0, 0], matrix[1, 1]) <= 0 or not np.array_equal(matrix[[1, 2, 2, 2], [0, 0, 1, 2]], [0, 0, 0, 1]):
        got = matrix.tolist()
        raise RecordingError(
            f"{fields.location('K')} is no camera matrix", got=got, expected="[[fx, s, cx], [0, fy, cy], [0, 0, 1]]"
        )
    streams = images_of(size)
    if streams:
        check_matrix_fits_images(matrix, size, fields.location("K"))
    if "depth" in streams and not fields.has("depth_scale"):
        raise RecordingError(
            f"{fields.location('depth_scale')} is missing", expected="metres per unit", remedy="0.001 for mm"
        )
    return Camera(
        width=size[0],
        height=size[1],
        K=matrix,
        T_world_camera=_transform(fields, "T_world_camera"),
        distortion=_distortion(fields),
        depth_scale=fields.optional(
            fields.number, "depth_scale", above=0, maximum=MAX_DEPTH_SCALE_M, suspect="units per metre"
        ),
        **streams,
        extra=fields.unknown_keys(),
    )


def _distortion(fields: Fields) -> np.ndarray:
    coefficients = fields.array("distortion", "N") if fields.has("distortion") else np.zeros(0)
    if len(coefficients) not in DISTORTION_COUNTS:
        raise RecordingError(
            f"{fields.location('distortion')} is cut off",
            got=f"{len(coefficients)} numbers",
            expected="0, 4, 5, 8, 12 or 14 in OpenCV's order k1 k2 p1 p2 k3 k4 k5 k6 s1..s4 tx ty",
            remedy="append the zeros that were left out",
        )
    return coefficients


def _sheet(fields: Fields) -> tuple[float, float]:
    width, height = (
        fields.number(key, above=0, maximum=checks.MAX_SCENE_EXTENT_M, suspect="millimetres")
        for key in ("width", "height")
    )
    return width, height


def _mesh(folder: Folder, file: str) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Vertices, faces, and pattern coordinates per vertex, or per corner where panels are sewn."""
    try:
        vertices, faces, corners = obj.parse(folder.read_text(file), folder.location(file))
        checks.check_metres(vertices, f"{folder.location(file)}: v")
        if corners is None:
            return vertices, faces, None
        checks.check_metres(corners, f"{folder.location(file)}: vt")
        check_metres(vertices, faces, corners, folder.location(file))
    except InvalidInput as error:
        raise RecordingError(error.what, got=error.got, expected=error.expected, remedy=error.remedy) from error
    uv = corner_to_vertex_values(faces, corners)
    return vertices, faces, corners if uv is None else uv


def _initial(folder: Folder, file: str, vertices: np.ndarray | None) -> np.ndarray:
    place = folder.location(file)
    initial = folder.read_npy(file)
    if vertices is not None:
        initial = checks.check_array(initial, place, (len(vertices), 3))
    elif initial.ndim == 3 and min(initial.shape[:2]) > 1:
        initial = checks.check_array(initial, place, ("M", "N", 3))
    else:
        raise RecordingError(
            f"{place} belongs to no mesh",
            got=list(initial.shape),
            expected="[M, N, 3], a grid on the sheet, or cloth.mesh in episode.json",
            remedy="write the mesh too",
        )
    checks.check_metres(initial, place)
    return initial


def _velocities(folder: Folder, file: str, start: str | None, vertices: np.ndarray | None) -> np.ndarray:
    place = folder.location(file)
    if start is None or vertices is None:
        raise RecordingError(
            f"{place} belongs to no first shape",
            expected="cloth.mesh and cloth.initial_vertices in episode.json",
            remedy="write both too, or leave the velocities out",
        )
    velocities = checks.check_array(folder.read_npy(file), place, (len(vertices), 3))
    fastest = float(np.abs(velocities).max(initial=0.0))
    if not fastest <= MAX_INITIAL_SPEED_M_PER_S:
        raise RecordingError(
            f"{place} is too fast",
            got=f"{fastest:g} m/s",
            expected=f"at most {MAX_INITIAL_SPEED_M_PER_S:g} m/s",
            remedy="are these millimetres per second?",
        )
    return velocities


def _nominal(fields: Fields) -> dict[str, Any]:
    """Data-sheet values by name; an unknown name is refused, for a typo would be ignored."""
    values = {}
    for key, value in list(fields.remaining.items()):
        if key not in (*NOMINAL_BOUNDS, NOMINAL_UNITS_KEY):
            expected = f"one of {', '.join((*NOMINAL_BOUNDS, NOMINAL_UNITS_KEY))}"
            raise RecordingError(f"{fields.location(key)} is unknown", expected=expected, remedy="correct its spelling")
        if value is not None:
            if key != NOMINAL_UNITS_KEY:
                fields.number(key, **NOMINAL_BOUNDS[key])
            values[key] = value  # unchanged, so that it is written as it was read
    return values


def _check_stiffness(nominal: dict[str, Any], thickness: float, place: str) -> None:
    """A membrane stiffness that is given twice must agree: one value would be ignored."""
    if {"membrane_stiffness", "youngs_modulus"} <= nominal.keys():
        given, expected = nominal["membrane_stiffness"], nominal["youngs_modulus"] * thickness
        if not np.isclose(given, expected, rtol=0.01):
            raise RecordingError(
                f"{place}.membrane_stiffness is not youngs_modulus times thickness",
                got=f"{given:g} N/m",
                expected=f"{expected:g} N/m",
                remedy="correct one of them, or leave it out",
            )


def _transform(fields: Fields, key: str) -> np.ndarray:
    return checks.check_transform(fields.array(key, 4, 4), fields.location(key))
