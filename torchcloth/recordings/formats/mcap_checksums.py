"""The checksums of an MCAP file: verified when reading, filled in after writing.

rosbags verifies those of chunks and writes none (0 stands for none, https://mcap.dev/spec). The data section's and the
summary's together cover every byte that is read.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import BinaryIO, Literal
from zlib import crc32

from ...errors import RecordingError

MAGIC = b"\x89MCAP0\r\n"
FOOTER = 9 + 20 + len(MAGIC)  # bytes of the footer record and the magic after it
MESSAGE, CHUNK, DATA_END, FOOTER_OP = 0x05, 0x06, 0x0F, 0x02
BLOCK = 1 << 20
Cover = Literal["all bytes", "messages", "none"]


def verify(path: Path) -> Cover:
    """Check the checksums of the sections, and say what is under one; rosbags checks those of the chunks.

    Raises:
        RecordingError: a checksum does not match, or the file has no end.
    """
    with path.open("rb") as file:
        data_end, summary_crc, summary_at, end, chunked = _sections(file, path)
        file.seek(data_end + 9)
        (data_crc,) = struct.unpack("<I", file.read(4))
        for name, crc, start, stop in (
            ("data", data_crc, 0, data_end),
            ("summary", summary_crc, summary_at, end),
        ):
            if crc and _crc(file, start, stop) != crc:
                remedy = "copy or record it again"
                raise RecordingError(f"{path} is damaged", got=f"a wrong checksum of its {name}", remedy=remedy)
        if not summary_crc:
            return "none"
        return "all bytes" if data_crc else "messages" if chunked else "none"


def seal(path: Path) -> None:
    """Fill in the checksums of an MCAP file that has none."""
    with path.open("r+b") as file:
        data_end, _, summary_at, end, _ = _sections(file, path)
        _put(file, data_end + 9, _crc(file, 0, data_end))
        _put(file, end, _crc(file, summary_at, end))


def _sections(file: BinaryIO, path: Path) -> tuple[int, int, int, int, bool]:
    """Where the data ends, the summary's checksum, where the summary begins, where its checksum is stored.

    Last, whether every message is in a chunk with a checksum.
    """
    size = file.seek(0, 2)
    file.seek(max(0, size - FOOTER))
    tail = file.read()
    if size < FOOTER + len(MAGIC) or tail[-8:] != MAGIC or tail[0] != FOOTER_OP:
        raise RecordingError(f"{path} has no end", expected="an MCAP footer", remedy="`mcap recover` may mend it")
    start, _, crc = struct.unpack("<QQI", tail[9:29])
    footer = size - FOOTER
    at, chunked = len(MAGIC), True
    while at < footer:
        file.seek(at)
        head = file.read(9)
        if head[0] == DATA_END:
            summary = start or footer
            if summary != at + 13 or struct.unpack("<Q", head[1:]) != (4,):
                raise RecordingError(f"{path} is damaged", got="a summary that is not where the footer says")
            return at, crc, summary, footer + 9 + 16, chunked
        if head[0] == CHUNK:  # its checksum lies behind two times and a length
            file.seek(24, 1)
            chunked &= file.read(4) != bytes(4)
        chunked &= head[0] != MESSAGE
        (length,) = struct.unpack("<Q", head[1:])
        at += 9 + length
    raise RecordingError(f"{path} is damaged", got="no end of its data", remedy="`mcap recover` may mend it")


def _crc(file: BinaryIO, start: int, stop: int) -> int:
    file.seek(start)
    crc, left = 0, stop - start
    while left > 0 and (block := file.read(min(BLOCK, left))):
        crc, left = crc32(block, crc), left - len(block)
    return crc


def _put(file: BinaryIO, at: int, value: int) -> None:
    file.seek(at)
    file.write(struct.pack("<I", value))
