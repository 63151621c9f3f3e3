"""The clouds of a folder of ``.pcd`` files, in the order of their times."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ...errors import RecordingError
from .. import checks
from .imported import MAX_SHOWN_CHARACTERS, read_bytes, to_seconds
from .pcd_file import parse_pcd
from .tables import Table, TimeUnit, find_time_columns, read_stamps, to_stamps

CLOUD_FILE_SUFFIX = ".pcd"
MAX_CLOUD_INTERVAL_S = 2.0  # between two clouds of a moving cloth
_LAST_NUMBER_PATTERN = re.compile(r"(\d+(?:\.\d+)?)\D*$")


class CloudTimes(NamedTuple):
    """The files of clouds with their times.

    Attributes:
        paths: N files, in the order of their times.
        ns: [N] ns, as recorded, increasing.
        notes: where the times are from, and what was guessed.
    """

    paths: list[Path]
    ns: np.ndarray
    notes: tuple[str, ...]


def list_cloud_files(folder: Path) -> list[Path]:
    """Return the ``.pcd`` files of a folder in the order of their names."""
    return sorted(path for path in folder.iterdir() if path.suffix.lower() == CLOUD_FILE_SUFFIX)


def read_cloud_times(folder: Path, table: Table | None, unit: TimeUnit | None) -> CloudTimes:
    """Read the times of a folder's clouds.

    Args:
        folder: with ``.pcd`` files.
        table: of a time for each cloud, by the name of its file or in the order of the names; None: times are in the
            names, such as ``pointcloud_1753623328.25_segmented.pcd``.
        unit: of the times; None: as the table says, or guessed.

    Raises:
        RecordingError: a cloud has no time, or two have the same.
    """
    paths = list_cloud_files(folder)
    if table is None:
        ns, notes = _read_names(folder, paths, unit)
    else:
        ns, notes = _read_table(table, paths, unit)
    order = np.argsort(ns, kind="stable")
    repeated = np.flatnonzero(np.diff(ns[order]) == 0)
    if len(repeated):
        first, second = (paths[order[k]].name for k in (repeated[0], repeated[0] + 1))
        raise RecordingError(f"{folder}: two clouds have one time", got=f"{first} and {second}", remedy="remove one")
    return CloudTimes([paths[k] for k in order], ns[order], notes)


def _read_names(folder: Path, paths: Sequence[Path], unit: TimeUnit | None) -> tuple[np.ndarray, tuple[str, ...]]:
    numbers = [_LAST_NUMBER_PATTERN.search(path.stem) for path in paths]
    texts = [number.group(1) for number in numbers if number]
    is_counted = len(texts) > 1 and float(np.median(np.diff(sorted(map(float, texts))))) == 1.0
    if len(texts) < len(paths) or is_counted:
        got = f"names such as {paths[0].name}"
        expected = "a CSV table with a time for each file, or times in the names"
        raise RecordingError(f"{folder} gives no times of its clouds", got=got, expected=expected)
    stamps = to_stamps(texts, f"{folder}: names of the clouds", MAX_CLOUD_INTERVAL_S, unit)
    return stamps.ns, stamps.notes


def _read_table(table: Table, paths: Sequence[Path], unit: TimeUnit | None) -> tuple[np.ndarray, tuple[str, ...]]:
    cells = range(len(table.rows[0]))
    names = next((k for k in cells if table.rows[0][k].lower().endswith(CLOUD_FILE_SUFFIX)), None)
    columns = find_time_columns(table)
    if columns[0] == names:
        columns = next((k for k in cells if k != names), columns[0]), None
    stamps = read_stamps(table, columns, MAX_CLOUD_INTERVAL_S, unit)
    notes = (*table.notes, *stamps.notes)
    if names is None:
        if len(table.rows) != len(paths):
            got = f"{len(table.rows)} times of {len(paths)} clouds"
            raise RecordingError(f"{table.path} does not fit the clouds", got=got, expected="a time for each cloud")
        return stamps.ns, notes
    by_name = dict(zip((Path(cell).name for cell in table.column(names)), stamps.ns.tolist(), strict=True))
    missing = next((path.name for path in paths if path.name not in by_name), None)
    if missing is not None:
        got = f"no time of {missing[:MAX_SHOWN_CHARACTERS]}"
        raise RecordingError(f"{table.path} does not fit the clouds", got=got, remedy="add it, or remove the file")
    return np.array([by_name[path.name] for path in paths], dtype=np.int64), notes


def read_clouds(
    times: CloudTimes, start_ns: int, T_world_points: np.ndarray
) -> tuple[dict[str, np.ndarray], list[str]]:
    """Read the clouds as in points.npz, in the world, and notes on what was left out.

    Args:
        times: the files.
        start_ns: time that becomes 0 s.
        T_world_points: [4, 4] m, pose in the world of the frame in which the points are given.

    Raises:
        RecordingError: a file is damaged, or no cloud has a point.
    """
    clouds = [parse_pcd(read_bytes(path), str(path)) for path in times.paths]
    counts = np.array([len(cloud) for cloud in clouds])
    if not counts.any():
        raise RecordingError(f"{times.paths[0].parent} has no points", got=f"{len(clouds)} empty clouds")
    xyz = checks.check_array(np.concatenate(clouds), f"{times.paths[0].parent}: points", ("N", 3))
    xyz = xyz @ T_world_points[:3, :3].T + T_world_points[:3, 3]
    is_empty = counts == 0
    notes = [f"{is_empty.sum()} of {len(clouds)} clouds have no point and are left out"] if is_empty.any() else []
    t = to_seconds(times.ns[~is_empty], start_ns)
    return {"t": t, "xyz": xyz, "counts": counts[~is_empty]}, notes
