"""Closed triangle meshes of the links whose solids a URDF gives as mesh files."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, cast

import numpy as np
from torch import Tensor

from torchcloth.errors import InvalidInput, MissingDependency
from torchcloth.recordings.robot_files import PACKAGE_PREFIXES, locate_mesh_file

if TYPE_CHECKING:
    import trimesh

Array = np.ndarray
MESH_READERS = (".stl", ".obj", ".ply")  # endings of the files that are read
MAX_MESH_FILE_BYTES = 64 * 2**20  # of one file
MAX_MESH_FACES = 1_000_000  # of one file


class MeshShape(NamedTuple):
    """A mesh file that is fixed to a body of the chain.

    Attributes:
        file: as the URDF names it.
        scale: [3], factors along the axes of the file.
        link: name of its link.
        body: 0 is the root; body j moves with joint j, counted from 1.
        pose: [4, 4] m, in that body.
    """

    file: str
    scale: tuple[float, float, float]
    link: str
    body: int
    pose: Tensor


def read_link_mesh(name: str, folder: Path, scale: tuple[float, float, float]) -> tuple[Array, Array]:
    """Read a mesh file as vertices [V, 3] m and triangles [F, 3] of a closed surface.

    A mesh that is closed is taken as it is. Another has no inside, so its convex hull is taken.

    Args:
        name: of the file, as a URDF says it (``locate_mesh_file``).
        folder: of the URDF.
        scale: factors along the axes of the file.

    Raises:
        InvalidInput: there is no such file, or it is of another format, too large, damaged or flat.
        MissingDependency: trimesh is not installed.
    """
    try:
        import trimesh
    except ImportError as error:
        remedy = 'pip install "torchcloth[robots]"'
        raise MissingDependency("meshes of a URDF need trimesh", got=str(error), remedy=remedy) from error
    path = locate_mesh_file(name, folder)
    if path is None:
        where = "beside it or up to four folders above" if name.startswith(PACKAGE_PREFIXES) else "relative to it"
        raise InvalidInput(
            f"mesh {name!r} of a URDF", got=f"no such file for the URDF in {folder}", expected=f"a file {where}"
        )
    suffix, size = path.suffix.lower(), path.stat().st_size
    if suffix not in MESH_READERS:
        remedy = "convert it, e.g. by Blender or meshlab, and name the new file in the URDF"
        raise InvalidInput(f"mesh {path}", got=suffix or "no ending", expected=", ".join(MESH_READERS), remedy=remedy)
    if size > MAX_MESH_FILE_BYTES:
        got, expected = f"{size / 2**20:.0f} MiB", f"at most {MAX_MESH_FILE_BYTES / 2**20:.0f} MiB"
        raise InvalidInput(f"mesh {path}", got=got, expected=expected, remedy="simplify it")
    try:  # from memory, without materials: the file cannot name others
        content = io.BytesIO(path.read_bytes())
        read = trimesh.load(content, file_type=suffix[1:], force="mesh", skip_materials=True)
        mesh = cast("trimesh.Trimesh", read)
        vertices, faces = np.asarray(mesh.vertices, float) * scale, np.asarray(mesh.faces, np.int64)
    except Exception as error:  # trimesh raises bare exceptions
        raise InvalidInput(f"mesh {path} cannot be read", got=error, remedy="export it again") from error
    if not 0 < len(faces) <= MAX_MESH_FACES or not np.isfinite(vertices).all():
        expected = f"finite vertices in 1 to {MAX_MESH_FACES} triangles"
        raise InvalidInput(f"mesh {path}", got=f"{len(faces)} triangles", expected=expected, remedy="export it again")
    mesh = trimesh.Trimesh(vertices, faces)  # merges the corners of an STL
    try:
        solid = mesh if mesh.is_watertight else mesh.convex_hull
    except Exception as error:  # of Qhull
        raise InvalidInput(f"mesh {path}", got="points of one plane", expected="a solid") from error
    return np.asarray(solid.vertices), np.asarray(solid.faces, np.int64)
