"""Files of one episode folder; any fault of a file becomes one ``RecordingError``."""

from __future__ import annotations

import json
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO, NoReturn

import numpy as np

from .._utils.unpacking import load_arrays
from ..errors import RecordingError, TorchclothError
from . import checks

LFS_POINTER_PREFIX = b"version https://git-lfs.github.com/spec/"  # of the text that stands for a file not fetched
ANNEX_POINTER_PREFIX = b"/annex/objects/"  # likewise, of an unlocked file of git-annex


def is_present(path: Path) -> bool:
    """Return whether a file or folder exists.

    Raises:
        RecordingError: the path is a link to nothing, so that data that were recorded would count as absent.
    """
    try:
        if path.exists():
            return True
        is_broken_link = path.is_symlink()
    except (OSError, ValueError):  # a name that no file system can hold
        return False
    if is_broken_link:
        raise RecordingError(
            f"{path} is a link to nothing",
            got=f"a link to {os.readlink(path)}",
            expected="a file or folder",
            remedy="fetch the data (dvc pull, git annex get, git lfs pull), or copy it with what the link names",
        )
    return False


def check_fetched(data: bytes, place: str) -> bytes:
    """Return the bytes of a file, unless they are the placeholder of a file whose data were not fetched.

    Raises:
        RecordingError: they are a placeholder of git-lfs or git-annex.
    """
    for prefix, tool, command in (
        (LFS_POINTER_PREFIX, "git-lfs", "git lfs pull"),
        (ANNEX_POINTER_PREFIX, "git-annex", "git annex get"),
    ):
        if data.startswith(prefix):
            got, expected = f"the placeholder of {tool}", "the file's own data"
            raise RecordingError(f"{place} was not fetched", got=got, expected=expected, remedy=f"run {command}")
    return data


class Folder:
    """An episode folder.

    Args:
        path: the folder.
        display_path: its name in messages; a writer checks its work under the final name.
        in_memory: files by name whose bytes lie in memory, such as files inside another format.
    """

    def __init__(
        self, path: Path, display_path: Path | None = None, in_memory: Mapping[str, bytes] | None = None
    ) -> None:
        self.path, self.display_path, self.in_memory = path, display_path or path, in_memory or {}

    def location(self, name: str) -> str:
        """Return the file's name for messages."""
        return str(self.display_path / name)

    def subfolder(self, name: str) -> Folder:
        """Return a folder inside this one."""
        return Folder(self.path / name, self.display_path / name)

    def has(self, name: str) -> bool:
        """Return whether a file or folder of this name exists here.

        Raises:
            RecordingError: the name is that of a link to nothing.
        """
        return name in self.in_memory or is_present(self.path / name)

    def read_bytes(self, name: str) -> bytes:
        """Return the bytes of a file that must exist."""
        place = self.location(name)
        checks.check_name(name, f"{place} file name")
        if not self.has(name):
            raise RecordingError(f"{place} is missing", expected="a file", remedy="restore it or stop naming it")
        if name in self.in_memory:
            return self.in_memory[name]
        try:
            return check_fetched((self.path / name).read_bytes(), place)
        except OSError as error:
            raise RecordingError(f"{place} cannot be read", got=error.strerror, expected="a readable file") from error

    def read_text(self, name: str) -> str:
        """Return the text of a UTF-8 file, without a byte order mark."""
        try:
            return self.read_bytes(name).decode("utf-8-sig")
        except UnicodeDecodeError as error:
            raise RecordingError(
                f"{self.location(name)} is not UTF-8 text", got=error.reason, remedy="restore it"
            ) from error

    def read_json(self, name: str) -> checks.Fields:
        """Read the JSON object in a file."""
        try:
            value = json.loads(
                self.read_text(name), parse_constant=_reject_constant, object_pairs_hook=_reject_repeated_keys
            )
        except RecordingError:
            raise
        except (ValueError, RecursionError) as error:
            raise RecordingError(
                f"{self.location(name)} is not valid JSON", got=error, remedy="restore or repair it"
            ) from error
        return checks.Fields(value, self.location(name), ": ")

    def read_npz(self, name: str) -> dict[str, np.ndarray]:
        """Read the arrays of an NPZ file; pickled objects are never loaded."""
        arrays = self._load(name)
        if not isinstance(arrays, dict):
            raise RecordingError(
                f"{self.location(name)} is not an NPZ archive", got="one bare array", expected="named arrays"
            )
        return arrays

    def read_npy(self, name: str) -> np.ndarray:
        """Read the array of an NPY file."""
        data = self._load(name)
        if isinstance(data, dict):
            raise RecordingError(f"{self.location(name)} is not an NPY array", got="an archive", expected="one array")
        return data

    def _load(self, name: str) -> dict[str, np.ndarray] | np.ndarray:
        data = self.read_bytes(name)
        try:
            arrays = load_arrays(data, self.location(name))
        except TorchclothError:
            raise
        except Exception as error:  # a damaged archive can raise almost anything: zlib, struct, numpy, memory
            raise RecordingError(
                f"{self.location(name)} is truncated, corrupt or holds pickled objects",
                got=type(error).__name__,  # numpy's own words advise to load it unsafely
                expected="plain numpy arrays",
                remedy="record or copy it again",
            ) from error
        for key, value in arrays.items() if isinstance(arrays, dict) else ():
            if not isinstance(value, np.ndarray):
                raise RecordingError(f"{self.location(name)}: {key} is not an array", expected="plain numpy arrays")
        return arrays


def save_npz(file: Path | BinaryIO, arrays: Mapping[str, Any]) -> None:
    """Write named arrays; the same arrays give the same bytes, and any name is allowed (unlike ``np.savez``)."""
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for key, value in arrays.items():
            member = zipfile.ZipInfo(f"{key}.npy")
            member.compress_type = zipfile.ZIP_DEFLATED
            with archive.open(member, "w", force_zip64=True) as opened:
                np.lib.format.write_array(opened, np.asarray(value), allow_pickle=False)


def _reject_repeated_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Refuse an object in which a key occurs twice: one of its values would be ignored."""
    values: dict[str, Any] = {}
    for key, value in pairs:
        if key in values:
            raise ValueError(f"{key!r} twice in an object")
        values[key] = value
    return values


def _reject_constant(text: str) -> NoReturn:
    raise ValueError(f"{text} is no JSON number")
