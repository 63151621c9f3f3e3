"""Times of the files of a folder, one for each image or cloud: from a table, or from the names."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ...errors import RecordingError
from .imported import MAX_SHOWN_CHARACTERS
from .tables import Table

MAX_FILE_INTERVAL_S = 2.0  # between two images or clouds of a moving cloth
_LAST_NUMBER_PATTERN = re.compile(r"(\d+(?:\.\d+)?)\D*$")


def find_last_number(path: Path) -> str | None:
    """Return the last number in the name of a file; None without one."""
    match = _LAST_NUMBER_PATTERN.search(path.stem)
    return match.group(1) if match else None


def are_frame_numbers(numbers: Sequence[str]) -> bool:
    """Return whether numbers in names count frames and tell no time."""
    return len(numbers) > 1 and float(np.median(np.diff(sorted(map(float, numbers))))) == 1.0


def find_file_column(table: Table, suffix: str) -> int | None:
    """Return the column of a table that names files with a suffix; None if there is none."""
    return next((k for k, cell in enumerate(table.rows[0]) if cell.lower().endswith(suffix)), None)


def assign_times(table: Table, files: int | None, ns: np.ndarray, paths: Sequence[Path], noun: str) -> np.ndarray:
    """Return the times [N] ns of files.

    Args:
        table: that the times are from.
        files: its column of the files' names; None: it has a time for each file, in the order of the paths.
        ns: [R] ns, times of its rows.
        paths: N files.
        noun: what a file is, in messages.

    Raises:
        RecordingError: a file has no time.
    """
    if files is None:
        if len(table.rows) != len(paths):
            got = f"{len(table.rows)} times of {len(paths)} {noun}s"
            raise RecordingError(f"{table.path} does not fit the {noun}s", got=got, expected=f"a time for each {noun}")
        return ns
    by_name = dict(zip((Path(cell).name for cell in table.column(files)), ns.tolist(), strict=True))
    missing = next((path.name for path in paths if path.name not in by_name), None)
    if missing is not None:
        got = f"no time of {missing[:MAX_SHOWN_CHARACTERS]}"
        raise RecordingError(f"{table.path} does not fit the {noun}s", got=got, remedy="add it, or remove the file")
    return np.array([by_name[path.name] for path in paths], dtype=np.int64)


def order_by_time(folder: Path, paths: Sequence[Path], ns: np.ndarray, noun: str) -> np.ndarray:
    """Return the order [N] of files by their times [N] ns.

    Raises:
        RecordingError: two files have one time.
    """
    order = np.argsort(ns, kind="stable")
    repeated = np.flatnonzero(np.diff(ns[order]) == 0).tolist()
    if repeated:
        first, second = (paths[int(order[k])].name for k in (repeated[0], repeated[0] + 1))
        raise RecordingError(f"{folder}: two {noun}s have one time", got=f"{first} and {second}", remedy="remove one")
    return order
