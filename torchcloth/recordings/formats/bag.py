"""Opens a ROS 2 bag (rosbag2 folder, or one .mcap or .db3 file) through rosbags and hands out its messages."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ...errors import MissingDependency, RecordingError
from . import mcap_checksums
from .imported import damaged

SQLITE = b"SQLite format 3\x00"
MAGICS = {".mcap": mcap_checksums.MAGIC, ".db3": SQLITE}
METADATA = "metadata.yaml"


class Message(NamedTuple):
    """One message of a bag."""

    topic: str
    logged: int  # ns, when it was received
    body: Any
    place: str


class Bag:
    """A ROS 2 bag whose checksums and counts have been looked at.

    Args:
        path: a rosbag2 folder, or a .mcap or .db3 file.

    Raises:
        RecordingError: the file is damaged or of another kind.
        MissingDependency: rosbags is not installed.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        files = [path] if path.is_file() else sorted(p for p in path.iterdir() if p.suffix in MAGICS)
        covers = [_check(file) for file in files] or ["none"]
        self.checksums = min(covers, key=("none", "messages", "all bytes").index)  # of the least protected file
        self.types, self._store = self._open()

    def messages(self, topics: Sequence[str]) -> Iterator[Message]:
        """The messages of these topics in the order of their logging; every one that the bag counts."""
        from rosbags.rosbag2 import Reader  # pyright: ignore[reportMissingImports]  (optional)

        with damaged(self.path, "ROS 2 bag"):
            reader = Reader(self.path)
            reader.open()
        try:
            wanted = [c for c in reader.connections if c.topic in topics]
            seen: Counter[str] = Counter()
            for message in self._deserialized(reader, wanted, seen):
                seen[message.topic] += 1
                yield message
            counted: Counter[str] = Counter()
            for connection in wanted:
                counted[connection.topic] += connection.msgcount
            if counted != seen:
                got, expected = dict(seen), f"{dict(counted)}, as the bag counts"
                raise RecordingError(f"{self.path} has lost messages", got=got, expected=expected)
        finally:
            reader.close()

    def _deserialized(self, reader: Any, wanted: list[Any], seen: Counter[str]) -> Iterator[Message]:
        stream: Iterator[Any] = reader.messages(connections=wanted) if wanted else iter(())
        while True:
            with damaged(self.path, "ROS 2 bag"):
                found = next(stream, None)
                if found is None:
                    return
                connection, logged, raw = found
                place = f"{self.path}: {connection.topic}[{seen[connection.topic]}]"
                body = self._store.deserialize_cdr(raw, connection.msgtype)
            yield Message(connection.topic, int(logged), body, place)

    def _open(self) -> tuple[dict[str, str], Any]:
        """Types by topic, and the definitions of all types, from the bag or else of ROS 2 Humble."""
        try:
            from rosbags.highlevel import AnyReader  # pyright: ignore[reportMissingImports]  (optional)
            from rosbags.typesys import Stores, get_typestore  # pyright: ignore[reportMissingImports]
        except ImportError as error:
            message = "reading ROS 2 bags needs rosbags"
            raise MissingDependency(message, remedy='pip install "torchcloth[data]"') from error
        with (
            damaged(self.path, "ROS 2 bag"),
            AnyReader([self.path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader,
        ):
            return {c.topic: c.msgtype for c in reader.connections}, reader.typestore


def is_bag(path: Path) -> bool:
    """Whether it is one, by its content."""
    if path.is_dir():
        return (path / METADATA).is_file()
    with path.open("rb") as file:
        return file.read(16).startswith(tuple(MAGICS.values()))


def _check(file: Path) -> mcap_checksums.Cover:
    """Look at magic and checksums of one storage file; what of it is under a checksum."""
    with file.open("rb") as opened:
        head = opened.read(16)
    kind = next((suffix for suffix, magic in MAGICS.items() if head.startswith(magic)), None)
    if kind != file.suffix:
        got = f"content of a {kind} file" if kind else repr(head[:8])
        raise RecordingError(f"{file} is mislabelled", got=got, expected=f"{file.suffix} content", remedy="rename it")
    if kind == ".mcap":
        with damaged(file, "MCAP file"):
            return mcap_checksums.verify(file)
    _check_sqlite(file)
    return "none"


def _check_sqlite(file: Path) -> None:
    import sqlite3

    place = str(file.resolve())
    if re.search("[#?]|%[0-9a-fA-F]{2}", place):  # rosbags, too, would open what is before these
        got, expected = "a path with #, ? or % in it", "one that stands for itself in a URI"
        raise RecordingError(f"{file} cannot be opened", got=got, expected=expected, remedy="rename the folder")
    for suffix in ("-wal", "-journal"):  # which are not looked at: the file is read as it is
        beside = file.with_name(file.name + suffix)
        if beside.is_file() and beside.stat().st_size:
            remedy = f"open and close it once with sqlite3, which takes in {beside.name}, or reindex the bag"
            raise RecordingError(f"{file} is unfinished", got=f"messages in {beside.name}", remedy=remedy)
    with damaged(file, "sqlite3 file"):
        connection = sqlite3.connect(f"file:{place}?immutable=1", uri=True)
        try:
            found = connection.execute("PRAGMA integrity_check").fetchone()[0]
        finally:
            connection.close()
    if found != "ok":
        raise RecordingError(f"{file} is damaged", got=found[:200], remedy="copy or record it again")
