"""Folders of point clouds: ``.pcd`` files of the cloth, with their times in a CSV table or in their names.

    *.pcd  [one .csv: a time for each file]  [more .csv: poses of grippers, named by the scene]

The points are in metres, in the world or in the frame of a camera or robot that the scene places. All of them count as
cloth. ``VIEWPOINT`` in the files is ignored, as by most programs.
"""

from __future__ import annotations

from pathlib import Path
from typing import cast

import numpy as np

from ...errors import RecordingError
from .. import checks
from ..checks import Fields
from ..files import is_present
from .cloud_files import CLOUD_FILE_SUFFIX, list_cloud_files, read_cloud_times, read_clouds
from .imported import Imported, Importer, reject_unknown_keys
from .pose_log import PoseLog, read_pose_log
from .scene_file import SceneFile
from .tables import UNIT_NAMES, TimeUnit, read_table

PCD_NAME = "pcd"
PCD_TITLE = "folder of .pcd point clouds"
PCD_UNCHECKED = "points, times and poses"
WORLD_FRAME = "world"


def matches(path: Path) -> bool:
    """Return whether a folder holds ``.pcd`` files."""
    return path.is_dir() and bool(list_cloud_files(path))


def describe_missing(path: Path) -> str:
    """Return what to pass instead of one cloud."""
    return "pass the folder of the clouds" if path.is_file() and path.suffix.lower() == CLOUD_FILE_SUFFIX else ""


def read(path: Path, scene: SceneFile, episode: int | None) -> Imported:
    """Read the clouds and the poses that the scene names.

    Args:
        path: the folder.
        scene: the scene file; ``source`` may hold ``times`` (the table), ``time_unit``, ``frame`` or
            ``T_world_points``, and ``motion.NAME`` with ``file``, ``closed`` and ``frame``.
        episode: unused; a folder holds one episode.

    Raises:
        RecordingError: the folder is damaged or incomplete, or the scene does not fit it.
    """
    source = scene.source
    unit = source.optional(source.text, "time_unit")
    if unit not in (None, *UNIT_NAMES):
        expected = f"one of {', '.join(UNIT_NAMES)}"
        raise RecordingError(f"{source.location('time_unit')} is unknown", got=repr(unit), expected=expected)
    time_unit = cast("TimeUnit | None", unit)
    T_world_points = _read_pose_of_points(source, scene)
    logs, closed, bases = {}, {}, {}
    motion_files = []
    for name, fields in source.named_groups("motion").items():
        motion_files.append(fields.text("file"))
        logs[name] = read_pose_log(_file_in(path, motion_files[-1], fields.location("file")), time_unit)
        closed[name] = fields.take("closed")
        if not isinstance(closed[name], bool):
            raise RecordingError(f"{fields.location('closed')} is unclear", got=closed[name], expected="true or false")
        bases[name] = scene.frame_pose(fields.optional(fields.text, "frame") or WORLD_FRAME)
        reject_unknown_keys(fields)
    table = source.optional(source.text, "times") or _find_table(path, motion_files)
    reject_unknown_keys(source)
    times = read_cloud_times(
        path, None if table is None else read_table(_file_in(path, table, source.location("times"))), time_unit
    )
    start = min(int(ns[0]) for ns in (times.ns, *(log.ns for log in logs.values())))
    points, notes = read_clouds(times, start, T_world_points)
    repairs = [*times.notes, *(note for log in logs.values() for note in log.notes), *notes]
    return Imported(
        motion={name: _to_motion(log, start, closed[name], bases[name]) for name, log in logs.items()},
        points=points,
        notes={"format": PCD_NAME, "start_ns": start, "unchecked": PCD_UNCHECKED, "repairs": repairs},
    )


def _to_motion(log: PoseLog, start: int, closed: bool, T_world_base: np.ndarray) -> dict[str, np.ndarray]:
    return log.to_motion(start, np.full(len(log.ns), closed), T_world_base)


def _read_pose_of_points(source: Fields, scene: SceneFile) -> np.ndarray:
    """Return the pose [4, 4] in the world of the frame in which the points are given."""
    matrix = source.optional(source.array, "T_world_points", 4, 4)
    frame = source.optional(source.text, "frame")
    if matrix is None:
        return scene.frame_pose(frame or WORLD_FRAME)
    if frame is not None:
        raise RecordingError(f"{source.location('frame')} and T_world_points", got="both", expected="one of them")
    return checks.check_transform(matrix, source.location("T_world_points"))


def _file_in(folder: Path, name: str, place: str) -> Path:
    """Return a file of the folder; a name may not lead out of it."""
    if Path(name).is_absolute() or ".." in Path(name).parts:
        raise RecordingError(f"{place} leaves the folder", got=repr(name), expected=f"a file in {folder}")
    if not is_present(folder / name):
        raise RecordingError(f"{place} names no file", got=repr(name), expected=f"a file in {folder}")
    return folder / name


def _find_table(folder: Path, others: list[str]) -> str | None:
    """Return the name of the one table that no gripper uses; None if there is none."""
    names = sorted(path.name for path in folder.iterdir() if path.suffix.lower() == ".csv" and path.name not in others)
    if len(names) > 1:
        remedy = f'write "source": {{"times": "{names[0]}"}}'
        raise RecordingError(f"{folder} holds several tables", got=", ".join(names[:6]), expected="one", remedy=remedy)
    return names[0] if names else None


PCD_IMPORTER = Importer(PCD_NAME, PCD_TITLE, matches, read, describe_missing)
