"""Limits on what compressed files may unpack to, checked by the sizes that they declare."""

from __future__ import annotations

import io
import math
import os
import zipfile
from collections.abc import Sequence
from typing import IO

import numpy as np

from ..errors import InvalidInput, RecordingError

UNPACKED_LIMIT_VARIABLE = "TORCHCLOTH_MAX_UNPACKED_GIB"
MAX_UNPACKED_GIB = 8.0  # of one file; an hour of clouds of 10000 points at 30 Hz is 6 GiB
MIN_SUSPECT_BYTES = 1 << 26  # files that unpack to less harm nobody, whatever their ratio
MAX_UNPACKING_RATIO = 200.0  # unpacked over packed bytes; clouds have 2, a motion that never moves has 100
BYTES_PER_GIB = 1 << 30


def check_unpacked_size(unpacked: int, packed: int, place: str) -> None:
    """Refuse a file that would fill the memory when it is unpacked.

    Args:
        unpacked: bytes after unpacking, as the file declares.
        packed: bytes of the file.
        place: its name, for messages.

    Raises:
        RecordingError: more than 8 GiB, or more than 64 MiB and 200 times the file; if ``TORCHCLOTH_MAX_UNPACKED_GIB``
            is set, more than that.
        InvalidInput: the variable is no number.
    """
    text = os.environ.get(UNPACKED_LIMIT_VARIABLE)
    try:
        limit = MAX_UNPACKED_GIB if text is None else float(text)
    except ValueError:
        raise InvalidInput(UNPACKED_LIMIT_VARIABLE, got=repr(text), expected="a number of GiB") from None
    is_suspect = text is None and unpacked > MIN_SUSPECT_BYTES and unpacked > MAX_UNPACKING_RATIO * packed
    if is_suspect or not unpacked <= limit * BYTES_PER_GIB:
        raise RecordingError(
            f"{place} unpacks to too much",
            got=f"{unpacked / BYTES_PER_GIB:.3g} GiB in a file of {packed / BYTES_PER_GIB:.2g} GiB",
            expected=f"at most {limit:g} GiB"
            + (f" and {MAX_UNPACKING_RATIO:g} times the file" if text is None else ""),
            remedy=f"if you trust it, set {UNPACKED_LIMIT_VARIABLE} to a larger number",
        )


def check_archive(archive: zipfile.ZipFile, packed: int, place: str, members: Sequence[str] | None = None) -> None:
    """Check the declared sizes of an archive's members, or of some of them, see ``check_unpacked_size``."""
    infos = [info for info in archive.infolist() if members is None or info.filename in members]
    check_unpacked_size(sum(info.file_size for info in infos), packed, place)
    for info in infos:
        if info.filename.endswith(".npy"):
            with archive.open(info) as member:
                _check_header(member, info.file_size, f"{place}: {info.filename}")


def load_arrays(data: bytes, place: str) -> dict[str, np.ndarray] | np.ndarray:
    """Load the arrays of an NPZ file, or the array of an NPY file, after a check of the sizes that it declares.

    Pickled objects are never loaded. A damaged file can raise almost anything.

    Raises:
        RecordingError: it would unpack to too much.
    """
    if zipfile.is_zipfile(io.BytesIO(data)):
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            check_archive(archive, len(data), place)
    else:
        _check_header(io.BytesIO(data), len(data), place)
    loaded = np.load(io.BytesIO(data), allow_pickle=False)
    return {key: loaded[key] for key in loaded.files} if isinstance(loaded, np.lib.npyio.NpzFile) else loaded


def _check_header(file: IO[bytes], size: int, place: str) -> None:
    """Refuse an array whose header declares more bytes than there are: numpy would reserve them."""
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(file)
    declared = math.prod(shape) * dtype.itemsize
    if declared > size and not dtype.hasobject:
        raise RecordingError(
            f"{place} is cut off", got=f"{size} bytes", expected=f"{declared} bytes of {list(shape)} {dtype}"
        )
