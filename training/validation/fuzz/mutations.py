"""Changes of the content of a file, inside of its container and with its checksums made right again."""

from __future__ import annotations

import io
import json
import re
import sqlite3
import struct
import warnings
import zipfile
from collections.abc import Iterator
from contextlib import closing
from itertools import islice
from random import Random
from typing import Any
from zlib import crc32

import numpy as np

from .formats import ByteMutation

TOKEN_PATTERN = re.compile(rb"[^\s\"'<>=,:/\[\]{}()]+")
WORDS = (
    b"0 -0 1 -1 2 3 1e-9 -1e-9 1e-300 1e300 -1e308 1e400 inf -inf nan 0.5 1e3 1000 255 256 65536 4294967295 "
    b"18446744073709551615 99999999999999999999 1_0 0x10 1.5 x"
).split()
JSON_VALUES = (None, True, 0, -1, 0.5, 1e-300, 1e300, 10**400, "", "x", "/", "..", "\x1b[2J", [], {}, [[]], [None])
INTEGERS = (0, 1, 2, 3, 7, 127, 128, 255, 256, 32767, 65535, 2**31 - 1, 2**31, 2**32 - 1, 2**53, 2**63 - 1, 2**64 - 1)
FLOATS = (0.0, -0.0, 1.0, -1.0, 1e-9, 1e-300, 1e30, 1e300, -1e300, float("inf"), float("-inf"), float("nan"))
DTYPES = ("f2", "f4", ">f8", "i1", "i2", "i8", "u8", "?", "c16", "S4", "U4", "m8[s]", "M8[s]")
RAW_SHARE = 0.1  # of inputs that are changed as plain bytes, container and checksums included
MAX_EDITS = 4
MCAP_MAGIC_BYTES, MCAP_HEAD_BYTES = 8, 9
MCAP_CHUNK, MCAP_DATA_END, MCAP_FOOTER = 0x06, 0x0F, 0x02
MCAP_FOOTER_BYTES = MCAP_HEAD_BYTES + 20 + MCAP_MAGIC_BYTES


def _edit_count(rng: Random) -> int:
    """Most inputs are changed at one place: more changes hide each other behind the first refusal."""
    return rng.choice((1, 1, 1, 2, MAX_EDITS))


def mutate_text(rng: Random, data: bytes, limit: int, mutate_bytes: ByteMutation) -> bytes:
    """Exchange, copy or delete words and lines."""
    if not data or rng.random() < RAW_SHARE:
        return mutate_bytes(data, limit)
    for _ in range(_edit_count(rng)):
        if rng.random() < 0.7:
            spans = [match.span() for match in TOKEN_PATTERN.finditer(data)] or [(0, 0)]
            (start, stop), (other, end) = rng.choice(spans), rng.choice(spans)
            word = rng.choice((rng.choice(WORDS), data[other:end], b"", mutate_bytes(data[start:stop], 32)))
            data = data[:start] + word + data[stop:]
        else:
            lines = data.splitlines(keepends=True) or [b""]
            i, k = rng.randrange(len(lines)), rng.randrange(len(lines))
            how = rng.randrange(4)
            if how == 0:
                del lines[i]
            elif how == 1:
                lines.insert(i, lines[k])
            elif how == 2:
                lines[i], lines[k] = lines[k], lines[i]
            else:
                lines = lines[: i + 1]
            data = b"".join(lines)
    return data[:limit]


def mutate_json(rng: Random, data: bytes, limit: int, mutate_bytes: ByteMutation) -> bytes:
    """Delete, rename or exchange values of a JSON tree."""
    try:
        tree = json.loads(data)
    except (ValueError, RecursionError):
        return mutate_text(rng, data, limit, mutate_bytes)
    if rng.random() < RAW_SHARE:
        return mutate_text(rng, data, limit, mutate_bytes)
    try:
        for _ in range(_edit_count(rng)):
            places = list(islice(_places(tree), limit + 1))
            if len(places) > limit:  # copies of copies grow without bound
                return data
            if places:
                _edit_json(rng, *rng.choice(places), rng.choice(places))
        changed = json.dumps(tree, separators=(",", ":")).encode("utf-8", "surrogatepass")
    except (ValueError, RecursionError):
        return data
    return changed if len(changed) <= limit else data


def _places(node: Any) -> Iterator[tuple[Any, Any]]:
    """Every container of a JSON tree with each of its keys; a tree may be deeper than Python's stack."""
    waiting = [node]
    while waiting:
        node = waiting.pop()
        for key in list(node) if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else ():
            yield node, key
            waiting.append(node[key])


def _edit_json(rng: Random, node: Any, key: Any, donor: tuple[Any, Any]) -> None:
    how, value = rng.randrange(7), node[key]
    if how == 0:
        del node[key]
    elif how == 1:
        node[key] = json.loads(json.dumps(donor[0][donor[1]]))
    elif how == 2 and isinstance(node, dict):
        node[f"{key}s" if rng.random() < 0.5 else str(donor[1])] = node.pop(key)
    elif how == 3 and isinstance(node, list):
        node.insert(key, value)
    elif how == 4 and isinstance(value, float) and np.isfinite(value):
        node[key] = rng.choice((-value, value * 1000, value / 1000, value + 1, value * (1 + 1e-4), int(value)))
    elif how == 4 and isinstance(value, int) and not isinstance(value, bool):
        node[key] = rng.choice((-value, value * 1000, value + 1, value - 1))
    else:
        node[key] = rng.choice(JSON_VALUES)


def mutate_in_place(rng: Random, data: bytes, limit: int, mutate_bytes: ByteMutation) -> bytes:
    """Change numbers of one to eight bytes, so that all else stays where it is."""
    if not data or rng.random() < RAW_SHARE:
        return mutate_bytes(data, limit)
    changed = bytearray(data)
    for _ in range(_edit_count(rng)):
        _overwrite(rng, changed, 0, len(changed), mutate_bytes)
    return bytes(changed)


def _overwrite(rng: Random, data: bytearray, start: int, stop: int, mutate_bytes: ByteMutation) -> None:
    """Change a few bytes between two places, and no length."""
    if stop <= start:
        return
    size = min(rng.choice((1, 1, 2, 4, 8, 8)), stop - start)
    at = rng.randrange(start, stop - size + 1)
    how = rng.randrange(4)
    if how == 0:
        new = rng.choice(INTEGERS).to_bytes(8, "little")[:size]
    elif how == 1 and size == 8:
        new = struct.pack("<d", rng.choice(FLOATS))
    elif how == 2:
        source = rng.randrange(start, stop - size + 1)
        new = bytes(data[source : source + size])
    else:
        new = mutate_bytes(bytes(data[at : at + size]), size)[:size]
    data[at : at + len(new)] = new


def mutate_npy(rng: Random, data: bytes, limit: int, mutate_bytes: ByteMutation) -> bytes:
    """Change an array's elements, shape or type, or the text of its header."""
    if rng.random() < RAW_SHARE:
        return mutate_text(rng, data, limit, mutate_bytes)
    try:
        array = np.load(io.BytesIO(data), allow_pickle=False)
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            array = _edit_array(rng, array)
        file = io.BytesIO()
        np.lib.format.write_array(file, array, allow_pickle=False)
    except Exception:  # a damaged array raises anything; it stays as it is
        return mutate_bytes(data, limit)
    return file.getvalue() if file.tell() <= limit else data


def _edit_array(rng: Random, array: np.ndarray) -> np.ndarray:
    """Make one plausible fault of a recorder."""
    array, how = array.copy(), rng.randrange(9)
    kind, size = array.dtype.kind, array.size
    if how <= 2 and size and kind in "fiub":
        values = FLOATS if kind == "f" else INTEGERS if kind in "iu" else (True, False)
        value = rng.choice((*values, array.flat[rng.randrange(size)]))
        limits = np.iinfo(array.dtype) if kind in "iu" else None
        clipped = value if limits is None else min(max(int(value), int(limits.min)), int(limits.max))
        array.flat[rng.randrange(size)] = clipped
        return array
    if how == 3:
        return array[..., None] if rng.random() < 0.5 or not array.ndim else array[0]
    if how == 4 and array.ndim:
        return array[: rng.randrange(len(array) + 1)]
    if how == 5 and array.ndim:
        return np.concatenate([array, array[:1]]) if rng.random() < 0.5 else array[::-1]
    if how == 6:
        return array.astype(rng.choice(DTYPES))
    if how == 7 and kind == "f":
        return array * rng.choice((1000.0, 1e-3, -1.0, 1 + 1e-4))
    return array.T if rng.random() < 0.5 else array.reshape(-1)


def mutate_zip(rng: Random, data: bytes, limit: int, mutate_bytes: ByteMutation) -> bytes:
    """Change, exchange, rename or drop members of an archive, and write it again with right checksums."""
    if rng.random() < RAW_SHARE / 3:
        return mutate_in_place(rng, data, limit, mutate_bytes)
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = [(info.filename, archive.read(info)) for info in archive.infolist()]
    except Exception:  # no sound archive; it raises anything
        return mutate_bytes(data, limit)
    for _ in range(_edit_count(rng)):
        if not members:
            break
        i, k, how = rng.randrange(len(members)), rng.randrange(len(members)), rng.randrange(20)
        name, content = members[i]
        if how == 0:
            del members[i]
        elif how == 1:
            members[i] = name, members[k][1]
        elif how == 2:
            members[i] = rng.choice((f"{name}s", members[k][0], f"x/{name}", name.rpartition("/")[2], "")), content
        else:
            members[i] = name, _mutate_member(rng, name, content, limit, mutate_bytes)
    file = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        warnings.simplefilter("ignore")  # two members of one name
        for name, content in members:
            archive.writestr(zipfile.ZipInfo(name or "x"), content)
    return file.getvalue() if file.tell() <= limit else data


def _mutate_member(rng: Random, name: str, content: bytes, limit: int, mutate_bytes: ByteMutation) -> bytes:
    if name.endswith(".npy"):
        return mutate_npy(rng, content, limit, mutate_bytes)
    if name.endswith(".npz"):
        return mutate_zip(rng, content, limit, mutate_bytes)
    if name.endswith(".json"):
        return mutate_json(rng, content, limit, mutate_bytes)
    return mutate_in_place(rng, content, limit, mutate_bytes)


def mutate_mcap(rng: Random, data: bytes, limit: int, mutate_bytes: ByteMutation) -> bytes:
    """Change records of an MCAP file, in chunks too, and make its checksums right again."""
    if rng.random() < RAW_SHARE:
        return mutate_bytes(data, limit)
    changed, records = bytearray(data), list(_mcap_records(data))
    if not records:
        return mutate_bytes(data, limit)
    for _ in range(_edit_count(rng)):
        opcode, start, stop = rng.choice(records)
        if opcode == MCAP_CHUNK and (content := _chunk_content(changed, start, stop)) is not None:
            _overwrite(rng, changed, content, stop, mutate_bytes)
        else:
            _overwrite(rng, changed, start, stop, mutate_bytes)
    for opcode, start, stop in records:
        if opcode == MCAP_CHUNK and (content := _chunk_content(changed, start, stop)) is not None:
            _put_checksum(changed, start + 24, changed[content:stop])
    end = next((start for opcode, start, _ in records if opcode == MCAP_DATA_END), None)
    if end is not None and len(changed) >= MCAP_FOOTER_BYTES:
        _put_checksum(changed, end, changed[: end - MCAP_HEAD_BYTES])
        footer = len(changed) - MCAP_FOOTER_BYTES + MCAP_HEAD_BYTES
        summary = min(int.from_bytes(changed[footer : footer + 8], "little") or len(changed), footer)
        _put_checksum(changed, footer + 16, changed[summary : footer + 16])
    return bytes(changed)


def _mcap_records(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Opcode, start and end of the content of every record outside of chunks."""
    at = MCAP_MAGIC_BYTES
    while at + MCAP_HEAD_BYTES <= len(data) - MCAP_MAGIC_BYTES:
        length = int.from_bytes(data[at + 1 : at + MCAP_HEAD_BYTES], "little")
        start = at + MCAP_HEAD_BYTES
        if start + length > len(data):
            return
        yield data[at], start, start + length
        at = start + length


def _chunk_content(data: bytearray, start: int, stop: int) -> int | None:
    """Where the records of a chunk begin, if they are not compressed."""
    content = start + 40
    is_plain = content <= stop and data[start + 28 : start + 32] == bytes(4)
    return content if is_plain else None


def _put_checksum(data: bytearray, at: int, content: bytearray) -> None:
    """Write a checksum where there was one; 0 means none."""
    if any(data[at : at + 4]):
        data[at : at + 4] = struct.pack("<I", crc32(content))


def mutate_sqlite(rng: Random, data: bytes, limit: int, mutate_bytes: ByteMutation) -> bytes:
    """Change values in the tables of a database."""
    if rng.random() < RAW_SHARE:
        return mutate_in_place(rng, data, limit, mutate_bytes)
    try:
        with closing(sqlite3.connect(":memory:")) as database:
            database.deserialize(data)
            for _ in range(_edit_count(rng)):
                _edit_row(rng, database, mutate_bytes)
            database.commit()
            changed = database.serialize()
    except Exception:  # no sound database; sqlite raises anything
        return mutate_in_place(rng, data, limit, mutate_bytes)
    return changed if len(changed) <= limit else data


def _edit_row(rng: Random, database: sqlite3.Connection, mutate_bytes: ByteMutation) -> None:
    tables = [name for (name,) in database.execute("select name from sqlite_master where type='table' order by name")]
    table = rng.choice([*tables, *["messages"] * len(tables)])
    rows = [row for (row,) in database.execute(f"select rowid from {table}")]
    columns = [column[1] for column in database.execute(f"pragma table_info({table})")]
    row, column, how = rng.choice(rows), rng.choice(columns), rng.randrange(10)
    if how == 0:
        database.execute(f"delete from {table} where rowid=?", (row,))
        return
    ((value,),) = database.execute(f"select {column} from {table} where rowid=?", (row,)).fetchall()
    if isinstance(value, bytes):
        content = bytearray(value)
        for _ in range(_edit_count(rng)):
            _overwrite(rng, content, 0, len(content), mutate_bytes)
        value = bytes(content)
    elif isinstance(value, int):
        value = rng.choice((value + 1, value - 10**9, -value, 0, 2**63 - 1, None, "x"))
    else:
        value = mutate_text(rng, str(value).encode(), len(str(value)) + 64, mutate_bytes).decode("utf-8", "replace")
    database.execute(f"update {table} set {column}=? where rowid=?", (value, row))
