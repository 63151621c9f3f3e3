"""Point clouds in files of the Point Cloud Library: ``.pcd``, as text, binary or compressed (LZF).

The header names the fields of a point; x, y and z are read. Memory is reserved only for what the file really holds. No
checksum covers the file: changed coordinates that stay plausible go unnoticed.
"""

from __future__ import annotations

import io
import struct
from itertools import accumulate
from typing import NamedTuple

import numpy as np

from ..._utils.unpacking import check_unpacked_size
from ...errors import RecordingError
from .imported import MAX_SHOWN_CHARACTERS

PCD_HEADER_KEYS = (
    *("VERSION", "FIELDS", "COLUMNS", "SIZE", "TYPE", "COUNT"),
    *("WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA"),
)
PCD_ENCODINGS = ("ascii", "binary", "binary_compressed")
MAX_HEADER_LINES = 64
MAX_HEADER_LINE_BYTES = 4096
MAX_NUMBER_DIGITS = 16
COORDINATE_TYPES = {("F", 4): "<f4", ("F", 8): "<f8"}  # by type and size
FIRST_REFERENCE_CONTROL = 32  # of LZF: smaller control bytes begin a run of literal bytes


class Coordinate(NamedTuple):
    """Where one coordinate stands in each point.

    Attributes:
        column: among the numbers of a point.
        offset: bytes from the beginning of a point.
        type: NumPy's name of the type.
    """

    column: int
    offset: int
    type: str


class PcdHeader(NamedTuple):
    """The layout of a file's points.

    Attributes:
        count: number of points.
        point_bytes: size of a point.
        xyz: the three coordinates.
        encoding: one of ``PCD_ENCODINGS``.
        end: where the data begin, in bytes.
    """

    count: int
    point_bytes: int
    xyz: list[Coordinate]
    encoding: str
    end: int


def parse_pcd(data: bytes, place: str) -> np.ndarray:
    """Return the points [N, 3] m of a ``.pcd`` file; points without a reading (NaN or all zero) are left out.

    Args:
        data: content of the file.
        place: its name, for messages.

    Raises:
        RecordingError: the file is damaged, declares another size than it has, or has no coordinates.
    """
    header = _read_header(data, place)
    if header.count == 0:
        return np.empty((0, 3))
    body = data[header.end :]
    if header.encoding == "ascii":
        points = _read_text(body, header, place)
    elif header.encoding == "binary":
        points = _read_binary(body, header, place)
    else:
        points = _read_compressed(body, header, place)
    return points[np.isfinite(points).all(1) & (points != 0).any(1)]


def _damaged(place: str, got: str, expected: str) -> RecordingError:
    return RecordingError(f"{place} is no sound .pcd file", got=got, expected=expected, remedy="export it again")


def _read_header(data: bytes, place: str) -> PcdHeader:
    entries, end = _read_entries(data, place)
    fields = entries.get("FIELDS", entries.get("COLUMNS", []))
    encoding = " ".join(entries["DATA"])
    if encoding not in PCD_ENCODINGS:
        raise _damaged(place, repr(f"DATA {encoding}"[:MAX_SHOWN_CHARACTERS]), f"DATA {' or '.join(PCD_ENCODINGS)}")
    types, sizes = entries.get("TYPE", []), _numbers(entries, "SIZE", place)
    counts = _numbers(entries, "COUNT", place) or [1] * len(fields)
    if not len(fields) == len(types) == len(sizes) == len(counts):
        got = f"{len(fields)} fields, {len(sizes)} sizes, {len(types)} types, {len(counts)} counts"
        raise _damaged(place, got, "as many of each")
    offsets = list(accumulate((size * count for size, count in zip(sizes, counts, strict=True)), initial=0))
    columns = list(accumulate(counts, initial=0))
    xyz = []
    for name in "xyz":
        matching = [k for k, field in enumerate(fields) if field == name]
        kind = None if len(matching) != 1 or counts[matching[0]] != 1 else (types[matching[0]], sizes[matching[0]])
        if kind not in COORDINATE_TYPES:
            got = repr(" ".join(fields)[:MAX_SHOWN_CHARACTERS])
            raise _damaged(place, f"fields {got}", "x, y and z once each, of type F and size 4 or 8")
        xyz.append(Coordinate(columns[matching[0]], offsets[matching[0]], COORDINATE_TYPES[kind]))
    return PcdHeader(_count_points(entries, place), offsets[-1], xyz, encoding, end)


def _read_entries(data: bytes, place: str) -> tuple[dict[str, list[str]], int]:
    """Return the words of each line of the header by key, and where the data begin."""
    entries: dict[str, list[str]] = {}
    start = 0
    for _ in range(MAX_HEADER_LINES):
        end = data.find(b"\n", start, start + MAX_HEADER_LINE_BYTES)
        key, *words = data[start : max(end, start)].decode("latin-1").split() or ["#"]
        if end < 0 or not (key.startswith("#") or (key in PCD_HEADER_KEYS and key not in entries)):
            break
        start = end + 1
        if not key.startswith("#"):
            entries[key] = words
        if key == "DATA":
            return entries, start
    got = repr(data[start : start + MAX_SHOWN_CHARACTERS].decode("latin-1"))
    raise _damaged(place, got, f"a header with lines {' '.join(PCD_HEADER_KEYS[3:])}")


def _numbers(entries: dict[str, list[str]], key: str, place: str, minimum: int = 1) -> list[int]:
    words = entries.get(key, [])
    numbers = [int(word) if word.isdecimal() and len(word) < MAX_NUMBER_DIGITS else -1 for word in words]
    if min(numbers, default=minimum) < minimum:
        got = repr(f"{key} {' '.join(words)}"[:MAX_SHOWN_CHARACTERS])
        raise _damaged(place, got, f"whole numbers of at least {minimum}")
    return numbers


def _count_points(entries: dict[str, list[str]], place: str) -> int:
    sides = [*_numbers(entries, "WIDTH", place, 0), *_numbers(entries, "HEIGHT", place, 0)]
    counts = {*_numbers(entries, "POINTS", place, 0), *([sides[0] * sides[1]] if len(sides) == 2 else [])}
    if len(counts) != 1:
        raise _damaged(place, f"WIDTH and HEIGHT {sides}, POINTS {entries.get('POINTS')}", "one number of points")
    return counts.pop()


def _read_text(body: bytes, header: PcdHeader, place: str) -> np.ndarray:
    columns = [coordinate.column for coordinate in header.xyz]
    try:
        points = np.loadtxt(io.BytesIO(body), usecols=columns, comments=None, ndmin=2, encoding="ascii")
    except ValueError as error:
        raise _damaged(place, str(error)[:MAX_SHOWN_CHARACTERS], "a row of numbers for each point") from error
    if len(points) != header.count:
        raise _damaged(place, f"{len(points)} rows", f"{header.count} points, as the header says")
    return points


def _read_binary(body: bytes, header: PcdHeader, place: str) -> np.ndarray:
    expected = header.count * header.point_bytes
    if len(body) != expected:
        raise _damaged(place, f"{len(body)} bytes of points", f"{expected}, as the header says")
    record = np.dtype(
        {
            "names": list("xyz"),
            "formats": [coordinate.type for coordinate in header.xyz],
            "offsets": [coordinate.offset for coordinate in header.xyz],
            "itemsize": header.point_bytes,
        }
    )
    points = np.frombuffer(body, record)
    return np.stack([points[name].astype(float) for name in "xyz"], axis=-1)


def _read_compressed(body: bytes, header: PcdHeader, place: str) -> np.ndarray:
    """Read points that are stored field by field, then compressed."""
    expected = header.count * header.point_bytes
    packed, unpacked = struct.unpack_from("<II", body) if len(body) >= 8 else (0, 0)
    if unpacked != expected or packed > len(body) - 8:
        got = f"{packed} of {len(body)} bytes for {unpacked}"
        raise _damaged(place, got, f"{expected} bytes of points, as the header says")
    check_unpacked_size(unpacked, len(body), place)
    fields = _decompress_lzf(body[8 : 8 + packed], unpacked)
    if len(fields) != unpacked:
        raise _damaged(place, f"{len(fields)} bytes after unpacking", f"{unpacked}, as the header says")
    starts = (header.count * coordinate.offset for coordinate in header.xyz)
    columns = [np.frombuffer(fields, c.type, header.count, start) for c, start in zip(header.xyz, starts, strict=True)]
    return np.stack([column.astype(float) for column in columns], axis=-1)


def _decompress_lzf(data: bytes, size: int) -> bytes:
    """Unpack LZF (Lehmann's liblzf) up to ``size`` bytes; damaged data give fewer or more bytes."""
    out = bytearray()
    i = 0
    while i + 1 < len(data) and len(out) <= size:
        control = data[i]
        i += 1
        if control < FIRST_REFERENCE_CONTROL:
            out += data[i : i + control + 1]
            i += control + 1
            continue
        length = control >> 5
        if length == 7:
            length += data[i]
            i += 1
        if i == len(data):
            break
        start = len(out) - ((control & 31) << 8) - data[i] - 1
        i += 1
        if start < 0:
            break
        repeated = bytes(out[start : start + length + 2])
        out += (repeated * (length + 2))[: length + 2]  # a reference may reach into what it writes
    return bytes(out)
