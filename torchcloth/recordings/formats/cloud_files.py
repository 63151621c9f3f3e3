"""The clouds of a folder of ``.pcd`` files, in the order of their times."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ...errors import RecordingError
from .. import checks
from .file_times import (
    MAX_FILE_INTERVAL_S,
    are_frame_numbers,
    assign_times,
    find_file_column,
    find_last_number,
    order_by_time,
)
from .imported import read_bytes, to_seconds
from .pcd_file import parse_pcd
from .tables import Table, TimeUnit, find_time_columns, read_stamps, to_stamps

CLOUD_FILE_SUFFIX = ".pcd"


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
    order = order_by_time(folder, paths, ns, "cloud")
    return CloudTimes([paths[k] for k in order], ns[order], notes)


def _read_names(folder: Path, paths: Sequence[Path], unit: TimeUnit | None) -> tuple[np.ndarray, tuple[str, ...]]:
    texts = [number for number in map(find_last_number, paths) if number is not None]
    if len(texts) < len(paths) or are_frame_numbers(texts):
        got = f"names such as {paths[0].name}"
        expected = "a CSV table with a time for each file, or times in the names"
        raise RecordingError(f"{folder} gives no times of its clouds", got=got, expected=expected)
    stamps = to_stamps(texts, f"{folder}: names of the clouds", MAX_FILE_INTERVAL_S, unit)
    return stamps.ns, stamps.notes


def _read_table(table: Table, paths: Sequence[Path], unit: TimeUnit | None) -> tuple[np.ndarray, tuple[str, ...]]:
    files, columns = find_file_column(table, CLOUD_FILE_SUFFIX), find_time_columns(table)
    if columns[0] == files:
        columns = next((k for k in range(len(table.rows[0])) if k != files), columns[0]), None
    stamps = read_stamps(table, columns, MAX_FILE_INTERVAL_S, unit)
    return assign_times(table, files, stamps.ns, paths, "cloud"), (*table.notes, *stamps.notes)


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
