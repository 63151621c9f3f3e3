"""Limits on what the compressed parts of a ROS bag unpack to.

rosbags unpacks each part at once, and the sizes that a bag declares need not be true: a hundred kilobytes of zstd can
unpack to gigabytes. Here a part is unpacked piece by piece, until it is more than ``check_unpacked_size`` allows.
"""

from __future__ import annotations

import bz2
import types
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from ..._utils.unpacking import check_unpacked_size
from ...errors import MissingDependency

PIECE_BYTES = 1 << 24
COMPRESSED_PART = "a compressed part of a bag"


@cache
def limit_rosbags() -> None:
    """Make rosbags unpack within limits.

    Raises:
        MissingDependency: rosbags is of another version, in which this is not known to work.
    """
    try:
        _replace_decompressors()
    except (ImportError, AttributeError, KeyError) as error:
        remedy = 'pip install --upgrade "torchcloth[data]"'
        raise MissingDependency("reading ROS bags needs another version of rosbags", remedy=remedy) from error


def _replace_decompressors() -> None:
    import rosbags.rosbag1.reader as ros1_reader  # pyright: ignore[reportMissingImports]  (optional)
    import rosbags.rosbag2.reader as ros2_reader  # pyright: ignore[reportMissingImports]
    import rosbags.rosbag2.storage_mcap as mcap_storage  # pyright: ignore[reportMissingImports]
    from lz4.frame import LZ4FrameDecompressor  # pyright: ignore[reportMissingImports]

    zstd: Any = vars(ros2_reader)["zstd"]
    makers = {"bz2": bz2.BZ2Decompressor, "lz4": LZ4FrameDecompressor, "zstd": zstd.ZstdDecompressor}
    for name in ("bz2", "lz4"):
        ros1_reader.decompressors[name] = lambda data, make=makers[name]: decompress(data, make)
    for name in ("lz4", "zstd"):
        mcap_storage.DECOMPRESSORS[name] = lambda data, _, make=makers[name]: decompress(data, make)
    ros2_reader.zstd = types.SimpleNamespace(  # type: ignore[attr-defined]
        decompress=lambda data: decompress(data, makers["zstd"]),
        open=lambda file, mode: BoundedReader(zstd.open(file, mode), Path(file.name)),
    )


def decompress(data: bytes, make: Callable[[], Any]) -> bytes:
    """Unpack one part of a bag.

    Args:
        data: one or more frames of a compression.
        make: makes the decompressor of one frame.

    Raises:
        RecordingError: it unpacks to too much.
        EOFError: it is cut off.
    """
    pieces, total, packed, decompressor = [], 0, len(data), make()
    while True:
        piece = decompressor.decompress(data, max_length=PIECE_BYTES)
        total += len(piece)
        check_unpacked_size(total, packed, COMPRESSED_PART)
        pieces.append(piece)
        data = b""
        if decompressor.eof:
            data, decompressor = decompressor.unused_data or b"", make()
            if not data:
                return b"".join(pieces)
        elif decompressor.needs_input:
            raise EOFError("a compressed part is cut off")


class BoundedReader:
    """A file that is unpacked while it is read.

    Args:
        file: gives the unpacked bytes.
        path: of the compressed file.
    """

    def __init__(self, file: Any, path: Path) -> None:
        self.file, self.path = file, path
        self.packed, self.total = path.stat().st_size, 0

    def __enter__(self) -> BoundedReader:
        return self

    def __exit__(self, *error: object) -> None:
        self.file.close()

    def read(self, size: int = -1) -> bytes:
        """Return at most so many bytes, and never more than a piece.

        Raises:
            RecordingError: the file unpacks to too much.
        """
        data = self.file.read(PIECE_BYTES if size < 0 else min(size, PIECE_BYTES))
        self.total += len(data)
        check_unpacked_size(self.total, self.packed, str(self.path))
        return data
