"""Checksums of an MCAP file: verified when it is read, filled in after it was written.

rosbags verifies those of chunks and writes none (0 means none, https://mcap.dev/spec). Those of the data section and of
the summary together cover every byte that is read.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import BinaryIO, Literal
from zlib import crc32

from ..._utils.unpacking import check_unpacked_size
from ...errors import RecordingError

MCAP_SIGNATURE = b"\x89MCAP0\r\n"
FOOTER_BYTES = 9 + 20 + len(MCAP_SIGNATURE)  # the footer record and the signature after it
MESSAGE_OPCODE, CHUNK_OPCODE, DATA_END_OPCODE, FOOTER_OPCODE = 0x05, 0x06, 0x0F, 0x02
READ_BLOCK_BYTES = 1 << 20
ChecksumCoverage = Literal["all bytes", "messages", "none"]


def verify_checksums(path: Path) -> ChecksumCoverage:
    """Verify the checksums of the sections and return what they cover; rosbags verifies those of the chunks.

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


def write_checksums(path: Path) -> None:
    """Fill in the checksums of an MCAP file that has none."""
    with path.open("r+b") as file:
        data_end, _, summary_at, end, _ = _sections(file, path)
        _put(file, data_end + 9, _crc(file, 0, data_end))
        _put(file, end, _crc(file, summary_at, end))


def _sections(file: BinaryIO, path: Path) -> tuple[int, int, int, int, bool]:
    """End of the data, checksum of the summary, start of the summary, and place of its checksum.

    The last value says whether every message is in a chunk with a checksum.
    """
    size = file.seek(0, 2)
    file.seek(max(0, size - FOOTER_BYTES))
    tail = file.read()
    if size < FOOTER_BYTES + len(MCAP_SIGNATURE) or tail[-8:] != MCAP_SIGNATURE or tail[0] != FOOTER_OPCODE:
        raise RecordingError(f"{path} has no end", expected="an MCAP footer", remedy="`mcap recover` may mend it")
    start, _, crc = struct.unpack("<QQI", tail[9:29])
    footer = size - FOOTER_BYTES
    at, chunked = len(MCAP_SIGNATURE), True
    while at < footer:
        file.seek(at)
        head = file.read(9)
        if head[0] == DATA_END_OPCODE:
            summary = start or footer
            if summary != at + 13 or struct.unpack("<Q", head[1:]) != (4,):
                raise RecordingError(f"{path} is damaged", got="a summary that is not where the footer says")
            return at, crc, summary, footer + 9 + 16, chunked
        (length,) = struct.unpack("<Q", head[1:])
        if head[0] == CHUNK_OPCODE:
            _, _, unpacked, chunk_crc = struct.unpack("<QQQI", file.read(28))
            check_unpacked_size(unpacked, length, f"{path}: a chunk")
            chunked &= chunk_crc != 0
        chunked &= head[0] != MESSAGE_OPCODE
        at += 9 + length
    raise RecordingError(f"{path} is damaged", got="no end of its data", remedy="`mcap recover` may mend it")


def _crc(file: BinaryIO, start: int, stop: int) -> int:
    file.seek(start)
    crc, remaining = 0, stop - start
    while remaining > 0 and (block := file.read(min(READ_BLOCK_BYTES, remaining))):
        crc, remaining = crc32(block, crc), remaining - len(block)
    return crc


def _put(file: BinaryIO, at: int, value: int) -> None:
    file.seek(at)
    file.write(struct.pack("<I", value))
