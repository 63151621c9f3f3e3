"""Structure of a Matroska file: its elements must fill it, one after the other (RFC 8794, RFC 9559).

FFmpeg reads on past damage and skips elements that it cannot decode; this walk detects the gap.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from ...errors import RecordingError

MATROSKA_SIGNATURE = b"\x1a\x45\xdf\xa3"
SEGMENT_ID, CLUSTER_ID, BLOCK_GROUP_ID = 0x18538067, 0x1F43B675, 0xA0
BLOCK_ID, SIMPLE_BLOCK_ID = 0xA1, 0xA3
CONTAINER_IDS = (SEGMENT_ID, CLUSTER_ID, BLOCK_GROUP_ID)
SKIPPED_ELEMENTS = {
    0x1A45DFA3: "EBML",
    0x114D9B74: "SeekHead",
    0x1549A966: "Info",
    0x1654AE6B: "Tracks",
    0x1C53BB6B: "Cues",
    0x1941A469: "Attachments",
    0x1043A770: "Chapters",
    0x1254C367: "Tags",
    0xEC: "Void",
    0xBF: "CRC-32",
    0xE7: "Timestamp",
    0xA7: "Position",
    0xAB: "PrevSize",
    0x9B: "BlockDuration",
    0xFB: "ReferenceBlock",
    0xFA: "ReferencePriority",
    0xA4: "CodecState",
    0x75A1: "BlockAdditions",
    0x75A2: "DiscardPadding",
}
LACING_MASK = 0x06


def count_blocks(path: Path) -> dict[int, int]:
    """Return the number of frames of each track number.

    Raises:
        RecordingError: an element is unknown, or ends beyond the file or before it.
    """
    counts: Counter[int] = Counter()
    size, at = path.stat().st_size, 0
    with path.open("rb") as file:
        while at < size:
            file.seek(at)
            head = file.read(20)  # four bytes of identity, eight of length, eight of a block's track number
            name, start, _ = _number(head, 0, keep_marker=True)
            length, start, unknown = _number(head, start)
            if name in (BLOCK_ID, SIMPLE_BLOCK_ID) and not unknown:
                track, after, _ = _number(head, start)
                if length < after + 3 - start or len(head) < after + 3:
                    raise _damaged(path, at)
                laced = head[after + 2] & LACING_MASK  # then the next byte is the number of frames after the first
                counts[track] += 1 + (head[after + 3] if laced and len(head) > after + 3 else 0)
            elif name not in CONTAINER_IDS and (unknown or name not in SKIPPED_ELEMENTS):
                raise _damaged(path, at)
            at += start + (0 if name in CONTAINER_IDS else length)
            if name == SEGMENT_ID and not unknown and at + length != size:
                got, expected = f"{size} bytes", f"{at + length}, as its head says"
                raise RecordingError(f"{path} is truncated", got=got, expected=expected, remedy="copy it again")
    if at != size:
        raise _damaged(path, at)
    return dict(counts)


def _number(data: bytes, at: int, *, keep_marker: bool = False) -> tuple[int, int, bool]:
    """A number of variable length, where it ends, and whether it means "unknown"."""
    if at >= len(data) or not data[at]:
        return 0, at + 1, True
    width = 9 - data[at].bit_length()  # one byte more than the first one has leading zeros
    value = int.from_bytes(data[at : at + width], "big")
    mask = (1 << 7 * width) - 1
    return value if keep_marker else value & mask, at + width, value & mask == mask


def _damaged(path: Path, at: int) -> RecordingError:
    return RecordingError(f"{path} is damaged", got=f"no sound element at byte {at}", remedy="copy it again")
