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


def copy_robot_files(recording: Recording, part: Path) -> Recording:
    """Copy the URDF of every arm, and the meshes below its folder, into an episode folder that is being written.

    A URDF that lies nowhere stays named as it is.

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
        for mesh in _meshes_below(file, content):
            target = folder / mesh
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes((file.parent / mesh).read_bytes())
        robots[name] = replace(robot, model=f"{root}/{name}/{file.name}")
    return replace(recording, robots=robots)


def _meshes_below(file: Path, content: bytes) -> list[PurePosixPath]:
    """Mesh files that a URDF names by paths within its own folder."""
    named = {PurePosixPath(path) for path in _MESH_FILE_PATTERN.findall(content.decode(errors="replace"))}
    inside = [path for path in named if not path.is_absolute() and ".." not in path.parts]
    paths = {path: (file.parent / path).resolve() for path in inside}
    return sorted(path for path, real in paths.items() if real.is_relative_to(file.parent) and real.is_file())
