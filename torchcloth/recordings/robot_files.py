"""Copies of the URDF files that an episode names, so that the episode can be moved without them."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path, PurePosixPath

from ..errors import RecordingError
from .files import is_present
from .types import Recording

ROBOTS_FOLDER = "robots"  # of an episode: a folder for each arm
URDF_SUFFIX = ".urdf"
MESH_SUFFIXES = (".stl", ".obj", ".ply", ".dae", ".glb", ".gltf")  # only such files are copied from other folders
MAX_PACKAGE_LEVELS = 4  # folders above a URDF in which its packages may lie
PACKAGE_PREFIXES = ("package://", "model://")
_MESH_FILE_PATTERN = re.compile(r"<mesh\b[^>]*?\bfilename\s*=\s*[\"']([^\"']+)[\"']")


def locate_urdf_file(model: str, folder: Path | None) -> Path | None:
    """Return the URDF file that a model names, in the folder of its episode or as a path; None for a model by name.

    Raises:
        RecordingError: it is a link to nothing.
    """
    if PurePosixPath(model).suffix.lower() != URDF_SUFFIX:
        return None
    paths = [Path(model)] if folder is None else [folder / model, Path(model)]
    return next((path.resolve() for path in paths if is_present(path) and path.is_file()), None)


def locate_mesh_file(name: str, folder: Path) -> Path | None:
    """Return the mesh file that a URDF names; None if there is no such file.

    A name is a path relative to the URDF, an absolute path, ``file://PATH`` or ``package://PACKAGE/PATH``. A package's
    folder lies beside the URDF or beside one of the four folders above it.

    Args:
        name: as the URDF says it.
        folder: of the URDF.
    """
    paths = [folder / path for path in (name.removeprefix("file://"), _inner_path(name))]
    if name.startswith(PACKAGE_PREFIXES):
        paths = [above / _inner_path(name) for above in (folder, *folder.parents[:MAX_PACKAGE_LEVELS])]
    return next((path for path in paths if is_present(path) and path.is_file()), None)


def _inner_path(name: str) -> PurePosixPath:
    """Path of a mesh below the folder of its URDF, where a copy of the URDF has it."""
    path = PurePosixPath(re.sub("^[a-z]+://", "", name))
    return PurePosixPath(*(part for part in path.parts if part not in ("..", path.anchor)))


def copy_robot_files(recording: Recording, part: Path) -> Recording:
    """Copy the URDF of every arm and its meshes into an episode folder that is being written.

    A URDF that lies nowhere stays named as it is. Meshes outside of the URDF's folder are copied if their names end as
    those of meshes do.

    Args:
        recording: to write.
        part: the new folder.

    Returns:
        The recording with the models of its arms as paths in the new folder.

    Raises:
        RecordingError: a file cannot be read, or is no URDF.
    """
    robots, root = dict(recording.robots), ROBOTS_FOLDER
    while root in recording.cameras:  # which has a folder of its own
        root += "_"
    for name, robot in robots.items():
        file = locate_urdf_file(robot.model, recording.path)
        if file is None:
            continue
        content = file.read_bytes()
        if b"<robot" not in content:
            raise RecordingError(f"{file} is no URDF", expected="<robot> as its first element", remedy="name a URDF")
        folder = part / root / name
        folder.mkdir(parents=True, exist_ok=True)
        (folder / file.name).write_bytes(content)
        for target, mesh in _locate_meshes(file, content).items():
            (folder / target).parent.mkdir(parents=True, exist_ok=True)
            (folder / target).write_bytes(mesh.read_bytes())
        robots[name] = replace(robot, model=f"{root}/{name}/{file.name}")
    return replace(recording, robots=robots)


def _locate_meshes(file: Path, content: bytes) -> dict[PurePosixPath, Path]:
    """Mesh files that a URDF names, by their places in the folder of its copy."""
    meshes = {}
    for name in sorted(set(_MESH_FILE_PATTERN.findall(content.decode(errors="replace")))):
        mesh = locate_mesh_file(name, file.parent)
        if mesh is None:
            continue
        real = mesh.resolve()
        if real.is_relative_to(file.parent) or real.suffix.lower() in MESH_SUFFIXES:
            meshes[_inner_path(name)] = real
    return meshes
