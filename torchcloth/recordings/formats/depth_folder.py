"""A folder of depth images whose times stand in a table, in the names of the images, or nowhere."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from ...errors import RecordingError
from ..files import is_present
from .file_times import (
    MAX_FILE_INTERVAL_S,
    are_frame_numbers,
    assign_times,
    find_file_column,
    find_last_number,
    order_by_time,
)
from .imported import NANOSECONDS_PER_SECOND
from .tables import STAMP_WORDS, Table, TimeUnit, find_time_columns, read_stamps, read_table, split_words, to_stamps

MIN_DEPTH_IMAGES = 4
TIME_FILE_NAMES = ("timestamps", "depth_times", "depth_timestamps", "times", "stamps", "depth")  # .csv or .txt


class DepthFolder(NamedTuple):
    """Depth images with their times.

    Attributes:
        paths: N files, in the order of their times.
        ns: [N] ns, as recorded, increasing.
        notes: where the times are from, and what was guessed.
    """

    paths: tuple[Path, ...]
    ns: np.ndarray
    notes: tuple[str, ...]


def read_depth_folder(
    folder: Path, *, times: Path | None = None, fps: float | None = None, time_unit: TimeUnit | None = None
) -> DepthFolder:
    """List the depth images of a folder and read their times; the images are not decoded.

    Args:
        folder: with PNG files.
        times: a table with a time for each image; None: one of a usual name in the folder or beside it, else the names
            of the images.
        fps: images per second, if nothing gives their times and their names are frame numbers.
        time_unit: of the times; None: as a header says, or guessed.

    Raises:
        RecordingError: the folder has no images, or their times are not known.
    """
    if not (is_present(folder) and folder.is_dir()):
        raise RecordingError(f"{folder} is no folder", expected="a folder of depth images", remedy="check the path")
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() == ".png")
    if len(paths) < MIN_DEPTH_IMAGES:
        got = f"{len(paths)} PNG files"
        raise RecordingError(f"{folder} holds no depth images", got=got, expected="16-bit PNG files, 0 where invalid")
    numbers = [find_last_number(path) for path in paths]
    table = times if times is not None else _find_time_file(folder)
    if fps is not None:
        frames = np.array([-1.0 if number is None else float(number) for number in numbers])
        if frames.min() < 0:
            raise RecordingError(f"{folder} holds unnumbered images", got=paths[0].name, expected="frame numbers")
        ns, notes = np.round((frames - frames.min()) * (NANOSECONDS_PER_SECOND / fps)).astype(np.int64), ()
    elif table is not None:
        ns, notes = _read_times(read_table(table), paths, time_unit)
    else:
        ns, notes = _times_in_names(folder, paths, numbers, time_unit)
    order = order_by_time(folder, paths, ns, "image")
    return DepthFolder(tuple(paths[k] for k in order), ns[order], tuple(notes))


def _find_time_file(folder: Path) -> Path | None:
    """Find the table of times in the folder, or beside it."""
    candidates = [
        place / f"{name}{suffix}"
        for place in (folder, folder.resolve().parent)
        for name in TIME_FILE_NAMES
        for suffix in (".csv", ".txt")
    ]
    return next((path for path in candidates if is_present(path) and path.is_file()), None)


def _read_times(table: Table, paths: list[Path], unit: TimeUnit | None) -> tuple[np.ndarray, list[str]]:
    """Times [N] ns of the images from a table that names them, numbers them, or lists a time for each in order."""
    files = find_file_column(table, ".png")
    column = _time_column(table, files)
    stamps = read_stamps(table, column, MAX_FILE_INTERVAL_S, unit)
    notes = [f"times of the images: {table.path.name}, {table.name_column(column[0])}", *table.notes, *stamps.notes]
    return assign_times(table, files, stamps.ns, paths, "image"), notes


def _time_column(table: Table, files: int | None) -> tuple[int, int | None]:
    """The column of the times: of depth images where there are several; no frame numbers, and no names of files."""
    words = [split_words(head) for head in table.heads or ()]
    for k, head in enumerate(words):
        if "depth" in head and k != files and ("t" in head or any(ranked & set(head) for ranked in STAMP_WORDS)):
            return k, None
    column, nanoseconds = find_time_columns(table)
    columns = [k for k in range(len(table.rows[0])) if k != files]
    if table.heads is None or column == files:
        usable = [k for k in columns if not _counts_frames(table.column(k))]
        return (usable or columns)[0], None
    return column, nanoseconds


def _counts_frames(cells: list[str]) -> bool:
    """Whether a column holds 0, 1, 2, ..., or any such range."""
    return all(cell.isdecimal() for cell in cells) and bool((np.diff([int(cell) for cell in cells]) == 1).all())


def _times_in_names(
    folder: Path, paths: list[Path], numbers: list[str | None], unit: TimeUnit | None
) -> tuple[np.ndarray, list[str]]:
    missing = next((path.name for path, number in zip(paths, numbers, strict=True) if number is None), None)
    texts = [number or "" for number in numbers]
    if missing is not None or are_frame_numbers(texts):
        got = f"frame numbers such as {paths[0].name}" if missing is None else missing
        expected = f"times in the names, or in {TIME_FILE_NAMES[0]}.csv in the folder or beside it"
        remedy = "name a table of times (--depth-times FILE), or state --fps"
        raise RecordingError(f"{folder} gives no times of its images", got=got, expected=expected, remedy=remedy)
    stamps = to_stamps(texts, f"{folder.name}: names of the images", MAX_FILE_INTERVAL_S, unit)
    return stamps.ns, [f"times of the images: in their names, such as {paths[0].name}", *stamps.notes]
