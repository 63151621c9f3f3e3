"""Ready meshes and meshes from files."""

from __future__ import annotations

from operator import index
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InvalidInput, MissingDependency
from . import obj
from .mesh import Mesh, check_metres

_INDEX = {"vertex_indices", "vertex_index"}  # names that PLY files use for the vertices of a face


def rectangle(
    width: float, height: float, *, triangles: int | None = None, resolution: tuple[int, int] | None = None
) -> Mesh:
    """Build a flat rectangular sheet in the world's xy plane, with its lower left corner at the origin.

    The diagonals alternate, so the mesh has no preferred shear direction. Material axes: warp = x, weft = y.

    Args:
        width: extent along x (warp) [m].
        height: extent along y (weft) [m].
        triangles: about how many triangles (cells near square); default 800.
        resolution: exact number of vertices (along x, along y) instead.

    Raises:
        InvalidInput: non-positive sizes or fewer than 2 vertices on a side.
    """
    if not (0 < width < np.inf and 0 < height < np.inf):
        raise InvalidInput("rectangle size", got=f"{width:g} x {height:g} m", expected="positive lengths")
    if resolution is None:
        triangles = 800 if triangles is None else triangles
        if triangles < 1:
            raise InvalidInput("triangles", got=triangles, expected="at least 1")
        cells = max(1.0, triangles / 2.0)
        columns = max(1, round((cells * width / height) ** 0.5))
        resolution = (columns + 1, max(1, round(cells / columns)) + 1)
    try:
        nx, ny = (index(n) for n in resolution)
    except (TypeError, ValueError):
        expected = "numbers of vertices along both sides, (NX, NY)"
        raise InvalidInput("resolution", got=repr(resolution), expected=expected) from None
    if nx < 2 or ny < 2:
        raise InvalidInput("resolution", got=resolution, expected="at least 2 vertices along each side")
    u, v = np.meshgrid(np.linspace(0.0, width, nx), np.linspace(0.0, height, ny), indexing="ij")
    uv = np.stack([u.ravel(), v.ravel()], axis=-1)
    i, j = (k.ravel() for k in np.meshgrid(np.arange(nx - 1), np.arange(ny - 1), indexing="ij"))
    a, b, c, d = i * ny + j, (i + 1) * ny + j, (i + 1) * ny + j + 1, i * ny + j + 1
    even = ((i + j) % 2 == 0)[:, None]
    first = np.where(even, np.stack([a, b, c], -1), np.stack([a, b, d], -1))
    second = np.where(even, np.stack([a, c, d], -1), np.stack([b, c, d], -1))
    faces = np.stack([first, second], axis=1).reshape(-1, 3)
    return Mesh.build(np.column_stack([uv, np.zeros(len(uv))]), faces, uv)


def load(path: str | Path) -> Mesh:
    """Load a cloth mesh from OBJ or PLY (metres), with the file's texture coordinates, if any, as the pattern.

    Where an OBJ gives a vertex several texture coordinates, panels are sewn: the mesh stays whole, and the edges are
    its ``seams``.

    Raises:
        InvalidInput: missing or unreadable file, not a usable triangle mesh, or texture coordinates that are not in
            metres.
        MissingDependency: trimesh, which reads all but OBJ, is not installed.
    """
    path = Path(path)
    if not path.is_file():
        raise InvalidInput("mesh file", got=str(path), expected="an existing OBJ or PLY file")
    if path.suffix.lower() not in (".obj", ".ply"):  # others know no vertices that triangles share
        raise InvalidInput("mesh file", got=str(path), expected="an OBJ or PLY file")
    if path.suffix.lower() == ".obj":
        return _in_metres(Mesh.build(*_read_obj(path)), path)
    try:
        import trimesh
    except ImportError as error:
        raise MissingDependency("reading PLY needs trimesh", remedy='pip install "torchcloth[robots]"') from error
    try:
        mesh = trimesh.load_mesh(path, process=False, maintain_order=True)
    except Exception as error:  # a damaged file raises whatever the parser pleases
        raise InvalidInput("mesh file", got=f"{path} ({error})", expected="a readable OBJ or PLY file") from error
    _check_polygons(mesh, path)
    uv = getattr(mesh.visual, "uv", None)
    arrays = mesh.vertices, mesh.faces, None if uv is None or len(uv) != len(mesh.vertices) else uv
    return _in_metres(Mesh.build(*(_wedges(mesh.metadata.get("_ply_raw"), path) or arrays)), path)


def _check_polygons(mesh: Any, path: Path) -> None:
    """Check that polygons have three corners or more and are convex: trimesh drops lines, and cuts into fans."""
    face = (mesh.metadata.get("_ply_raw") or {}).get("face") or {}
    for name in _INDEX & (face.get("properties") or {}).keys():
        corners = _rows(face, name)
        _check_corner_counts(corners, path)
        groups = [corners] if corners.ndim == 2 else [np.stack(group) for group in _by_corner_count(corners)]
        for polygons in groups:
            if polygons.shape[1] > 3:
                _check_corners(polygons, len(mesh.vertices), path)
                obj.check_convex(np.asarray(mesh.vertices)[polygons], str(path))


def _check_corner_counts(corners: np.ndarray, path: Path) -> None:
    counts = [len(row) if np.ndim(row) else 1 for row in corners]
    few = next((k for k, count in enumerate(counts) if count < 3), None)
    if few is not None:
        got = f"{path}, damaged at face {few + 1} of {len(counts)}, which has {counts[few]} corners"
        raise InvalidInput("mesh file", got=got, expected="faces of three corners or more", remedy="export it again")


def _check_corners(polygons: np.ndarray, count: int, path: Path) -> None:
    if polygons.dtype.kind not in "iu":
        got = f"{path}, faces of {polygons.dtype} numbers"
        raise InvalidInput("mesh file", got=got, expected="vertex numbers as integers", remedy="export it again")
    if polygons.min() < 0 or polygons.max() >= count:
        got = f"{path}, a face with vertex {int(polygons.max() if polygons.max() >= count else polygons.min())}"
        raise InvalidInput("mesh file", got=got, expected=f"vertices 0 to {count - 1}")


def _rows(face: Any, key: str) -> np.ndarray:
    """Return a list property of the faces, one row each; an object array where rows differ in length."""
    data = face["data"][key]
    return np.asarray(data["f1"] if getattr(data.dtype, "names", None) else data)


def _by_corner_count(rows: np.ndarray) -> list[list[np.ndarray]]:
    groups: dict[int, list[np.ndarray]] = {}
    for row in rows:
        groups.setdefault(len(row), []).append(np.asarray(row))
    return list(groups.values())


def _wedges(raw: Any, path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Return vertices, faces and corner coordinates of a PLY that has coordinates per corner, as of MeshLab; or None.

    trimesh would tear such a mesh apart at its seams.
    """
    face = (raw or {}).get("face") or {}
    name = next((n for n in ("texcoord", "texcoords") if n in face.get("properties", ())), None)
    if name is None:
        return None

    index = _INDEX & face["properties"].keys()
    if not index:
        raise InvalidInput("mesh file", got=f"{path}, faces without vertices", expected="a list of vertex_indices")
    corners, coordinates, place = _rows(face, index.pop()), _rows(face, name), raw["vertex"]["data"]
    if corners.ndim != 2 or coordinates.shape != (len(corners), 2 * corners.shape[1]):
        got = f"{path}, polygons of several kinds with coordinates of their corners"
        raise InvalidInput("mesh file", got=got, expected="triangles", remedy="triangulate on export")
    vertices = np.stack([np.asarray(place[axis], dtype=float).ravel() for axis in "xyz"], axis=-1)
    _check_corners(corners, len(vertices), path)
    fan = np.array([[0, k, k + 1] for k in range(1, corners.shape[1] - 1)])
    obj.check_convex(vertices[corners], str(path))
    return vertices, corners[:, fan].reshape(-1, 3), coordinates.reshape(*corners.shape, 2)[:, fan].reshape(-1, 3, 2)


def _in_metres(mesh: Mesh, path: Path) -> Mesh:
    check_metres(mesh.vertices, mesh.faces, mesh.pattern, str(path))
    return mesh


def _read_obj(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    try:
        return obj.parse(path.read_text(encoding="utf-8-sig"), str(path))
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidInput("mesh file", got=f"{path} ({error})", expected="a readable OBJ or PLY file") from error
