"""Atomic writing of folders: a folder is written under a temporary name and then renamed."""

from __future__ import annotations

import os
import shutil
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ..errors import RecordingError


def write_folder_atomically(target: Path, fill: Callable[[Path, Path], None], *, marker: str, overwrite: bool) -> Path:
    """Write a folder. On any failure the final name holds the old folder or the new one, complete.

    Args:
        target: its final name.
        fill: called with (the folder to write into, its final name for messages).
        marker: the file that shows that an old folder may be replaced.
        overwrite: replace an old folder; a folder without the marker is never replaced.

    Returns:
        ``target``.

    Raises:
        RecordingError: the target exists, ``fill`` refuses, or the disk fails.
    """
    _check(target, marker, overwrite)
    part = target.absolute().with_name(f".{target.absolute().name}.{uuid.uuid4().hex}.partial")
    try:
        with temporary_path(part):
            part.mkdir()
            fill(part, target)
            _sync_all(part)
            _put(part, target.absolute(), overwrite)
    except RecordingError:
        raise
    except (OSError, ValueError, TypeError, RuntimeError) as error:  # disk, or a value that JSON and NPZ cannot hold
        raise RecordingError(f"{target} cannot be written", got=error, remedy="nothing was changed") from error
    return target


@contextmanager
def temporary_path(part: Path) -> Iterator[None]:
    """Create the folders above ``part`` and remove ``part`` at the end.

    After a failure the created folders are removed as well.
    """
    created = [folder for folder in part.parents if not folder.exists()]
    try:
        part.parent.mkdir(parents=True, exist_ok=True)
        yield
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        for folder in created:
            with suppress(OSError):
                folder.rmdir()
        raise
    shutil.rmtree(part, ignore_errors=True)


def _check(target: Path, marker: str, overwrite: bool) -> None:
    if not os.path.lexists(target):
        return
    if not overwrite:
        raise RecordingError(f"{target} exists", expected="a new name", remedy="pass overwrite=True to replace it")
    if target.is_symlink():
        raise RecordingError(f"{target} is a link", expected="a folder to replace", remedy="name what it points to")
    if not (target / marker).is_file():
        raise RecordingError(f"{target} holds no {marker}", expected="one to replace", remedy="choose another name")


def _put(part: Path, target: Path, overwrite: bool) -> None:
    """Rename into place. An existing episode is moved aside first and comes back after a failure."""
    old = part.with_suffix(".old")
    if overwrite and target.exists():  # without overwrite, a folder that appeared meanwhile makes the rename below fail
        target.rename(old)
    try:
        part.rename(target)
    except BaseException:
        if old.exists():
            old.rename(target)
        raise
    sync_to_disk(target.parent)
    shutil.rmtree(old, ignore_errors=True)


def _sync_all(root: Path) -> None:
    for folder, _, files in os.walk(root, topdown=False):
        for file in files:
            sync_to_disk(Path(folder, file))
        sync_to_disk(Path(folder))


def sync_to_disk(path: Path) -> None:
    """Flush a file or folder to the disk."""
    if path.is_dir() and os.name == "nt":  # Windows cannot open a folder
        return
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
