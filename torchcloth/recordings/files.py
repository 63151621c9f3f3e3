"""Opens the files of one episode folder; whatever is wrong with a file becomes one `RecordingError`."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO, NoReturn

import numpy as np

from ..errors import RecordingError
from . import checks


class Folder:
    """An episode folder; ``shown`` is the name used in messages (a write checks its work under the final name).

    ``held`` are files by name that lie in memory instead, as those that another format carries.
    """

    def __init__(self, path: Path, shown: Path | None = None, held: Mapping[str, bytes] | None = None) -> None:
        self.path, self.shown, self.held = path, shown or path, held or {}

    def place(self, name: str) -> str:
        """The file's name in messages."""
        return str(self.shown / name)

    def sub(self, name: str) -> Folder:
        """A folder inside this one."""
        return Folder(self.path / name, self.shown / name)

    def has(self, name: str) -> bool:
        """Whether a file or folder of this name lies here."""
        try:
            return name in self.held or (self.path / name).exists()
        except (OSError, ValueError):  # a name that no file system can hold
            return False

    def data(self, name: str) -> bytes:
        """The bytes of a file that must be there."""
        place = self.place(name)
        checks.name(name, f"{place} file name")
        if not self.has(name):
            raise RecordingError(f"{place} is missing", expected="a file", remedy="restore it or stop naming it")
        if name in self.held:
            return self.held[name]
        try:
            return (self.path / name).read_bytes()
        except OSError as error:
            raise RecordingError(f"{place} cannot be read", got=error.strerror, expected="a readable file") from error

    def text(self, name: str) -> str:
        """The text of a UTF-8 file."""
        try:
            return self.data(name).decode()
        except UnicodeDecodeError as error:
            raise RecordingError(
                f"{self.place(name)} is not UTF-8 text", got=error.reason, remedy="restore it"
            ) from error

    def json(self, name: str) -> checks.Fields:
        """The JSON object in a file."""
        try:
            value = json.loads(self.text(name), parse_constant=_no_constant, object_pairs_hook=_once)
        except RecordingError:
            raise
        except (ValueError, RecursionError) as error:
            raise RecordingError(
                f"{self.place(name)} is not valid JSON", got=error, remedy="restore or repair it"
            ) from error
        return checks.Fields(value, self.place(name), ": ")

    def npz(self, name: str) -> dict[str, np.ndarray]:
        """The arrays of an NPZ file; pickled objects are never loaded."""
        arrays = self._load(name)
        if not isinstance(arrays, dict):
            raise RecordingError(
                f"{self.place(name)} is not an NPZ archive", got="one bare array", expected="named arrays"
            )
        return arrays

    def npy(self, name: str) -> np.ndarray:
        """The array of an NPY file."""
        data = self._load(name)
        if isinstance(data, dict):
            raise RecordingError(f"{self.place(name)} is not an NPY array", got="an archive", expected="one array")
        return data

    def _load(self, name: str) -> dict[str, np.ndarray] | np.ndarray:
        data = self.data(name)
        try:
            loaded = np.load(io.BytesIO(data), allow_pickle=False)
            arrays = {key: loaded[key] for key in loaded.files} if isinstance(loaded, np.lib.npyio.NpzFile) else loaded
        except Exception as error:  # a damaged archive can raise almost anything: zlib, struct, numpy, memory
            raise RecordingError(
                f"{self.place(name)} is truncated, corrupt or holds pickled objects",
                got=type(error).__name__,  # numpy's own words advise to load it unsafely
                expected="plain numpy arrays",
                remedy="record or copy it again",
            ) from error
        for key, value in arrays.items() if isinstance(arrays, dict) else ():
            if not isinstance(value, np.ndarray):
                raise RecordingError(f"{self.place(name)}: {key} is not an array", expected="plain numpy arrays")
        return arrays


def save_npz(file: Path | BinaryIO, arrays: Mapping[str, Any]) -> None:
    """Write named arrays; the same arrays give the same bytes, and any name is allowed (unlike ``np.savez``)."""
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for key, value in arrays.items():
            member = zipfile.ZipInfo(f"{key}.npy")
            member.compress_type = zipfile.ZIP_DEFLATED
            with archive.open(member, "w", force_zip64=True) as opened:
                np.lib.format.write_array(opened, np.asarray(value), allow_pickle=False)


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object of a file that someone edited: of a key that stands there twice, one would be ignored."""
    found = dict(pairs)
    if len(found) < len(pairs):
        keys = [key for key, _ in pairs]
        raise ValueError(f"{next(key for key in keys if keys.count(key) > 1)!r} twice in an object")
    return found


def _no_constant(text: str) -> NoReturn:
    raise ValueError(f"{text} is no JSON number")
