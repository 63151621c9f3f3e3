"""Reader of ROS bags (a rosbag2 folder, one .mcap or .db3 file, or a .bag file of ROS 1), by rosbags."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, NamedTuple

from ...errors import MissingDependency, RecordingError
from ..files import is_present
from . import mcap_checksums
from .bounded_decompression import limit_rosbags
from .imported import report_damage

SQLITE_SIGNATURE = b"SQLite format 3\x00"
STORAGE_SIGNATURES = {".mcap": mcap_checksums.MCAP_SIGNATURE, ".db3": SQLITE_SIGNATURE}
ROS1_SIGNATURE, ROS1_SUFFIX = b"#ROSBAG V2.0", ".bag"
METADATA_FILE = "metadata.yaml"
# What is computed when it is read, perhaps without end.
COMPUTED_TABLES_QUERY = (
    "select type, name from sqlite_master where type in ('view', 'trigger') or sql like 'create virtual%'"
)


class BagMessage(NamedTuple):
    """One message of a bag.

    Attributes:
        topic: its topic.
        log_time: ns, when it was received.
        body: the deserialised message.
        place: bag, topic and number, for messages.
    """

    topic: str
    log_time: int
    body: Any
    place: str


class Bag:
    """A ROS bag whose checksums and counts are verified.

    Args:
        path: a rosbag2 folder, or a .mcap, .db3 or .bag file.

    Attributes:
        notes: what was mended.
        checksums: what the bag's checksums cover: "all bytes", "messages" or "none".
        types: message types by topic.

    Raises:
        RecordingError: the file is damaged or of another kind.
        MissingDependency: rosbags is not installed.
    """

    def __init__(self, path: Path) -> None:
        self.notes: list[str] = []
        self.path = path
        files = [path] if path.is_file() else storage_files(path)
        if path.is_dir() and not is_present(path / METADATA_FILE):
            self.path = self._only_storage_file(files)
        self.is_ros1 = self.path.suffix == ROS1_SUFFIX
        coverages = ["none"] if self.is_ros1 else [_verify_file(file) for file in files] or ["none"]
        self.checksums = min(coverages, key=("none", "messages", "all bytes").index)  # that of the least protected file
        self.types, self._store = self._open()

    def messages(self, topics: Sequence[str]) -> Iterator[BagMessage]:
        """Iterate over the messages of these topics in the order of their logging; every message that the bag counts.

        Raises:
            RecordingError: messages are missing or damaged.
        """
        from rosbags import rosbag1, rosbag2  # pyright: ignore[reportMissingImports]  (optional)

        with self._report_damage():
            reader: Any = rosbag1.Reader(self.path) if self.is_ros1 else rosbag2.Reader(self.path)
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

    def _deserialized(self, reader: Any, wanted: list[Any], seen: Counter[str]) -> Iterator[BagMessage]:
        stream: Iterator[Any] = reader.messages(connections=wanted) if wanted else iter(())
        while True:
            with self._report_damage():
                message = next(stream, None)
                if message is None:
                    return
                connection, logged, raw = message
                place = f"{self.path}: {connection.topic}[{seen[connection.topic]}]"
                deserialize = self._store.deserialize_ros1 if self.is_ros1 else self._store.deserialize_cdr
                body = deserialize(raw, connection.msgtype)
                bag_message = BagMessage(connection.topic, int(logged), body, place)
            yield bag_message

    def _report_damage(self) -> AbstractContextManager[None]:
        if self.is_ros1:
            return report_damage(self.path, "ROS 1 bag", remedy="reindex it (rosbag reindex), or copy it again")
        return report_damage(self.path, "ROS 2 bag")

    def _only_storage_file(self, files: list[Path]) -> Path:
        """The storage file of a folder without metadata, as a killed recorder leaves it."""
        if len(files) != 1:
            raise RecordingError(
                f"{self.path / METADATA_FILE} is missing",
                got=f"{len(files)} storage files",
                expected="the list of the files and their messages",
                remedy=f"write it: ros2 bag reindex {self.path}",
            )
        self.notes.append(f"{METADATA_FILE} is missing, so {files[0].name} was read; ros2 bag reindex writes it")
        return files[0]

    def _open(self) -> tuple[dict[str, str], Any]:
        """Types by topic, and the definitions of all types, from the bag or else of ROS 2 Humble."""
        try:
            from rosbags.highlevel import AnyReader  # pyright: ignore[reportMissingImports]  (optional)
            from rosbags.typesys import Stores, get_typestore  # pyright: ignore[reportMissingImports]
        except ImportError as error:
            message = "reading ROS bags needs rosbags"
            raise MissingDependency(message, remedy='pip install "torchcloth[data]"') from error
        limit_rosbags()
        with (
            self._report_damage(),
            AnyReader([self.path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader,
        ):
            return {c.topic: c.msgtype for c in reader.connections}, reader.typestore


def storage_files(folder: Path) -> list[Path]:
    """Return the .mcap and .db3 files of a folder, sorted by name."""
    return sorted(p for p in folder.iterdir() if p.suffix in STORAGE_SIGNATURES and is_present(p))


def is_bag(path: Path) -> bool:
    """Return whether a path is a ROS bag, by its content."""
    if path.is_dir():
        has_only_files = not any(p.is_dir() for p in path.iterdir())
        return is_present(path / METADATA_FILE) or (has_only_files and bool(storage_files(path)))
    with path.open("rb") as file:
        head = file.read(16)
    is_ros1 = head.startswith(ROS1_SIGNATURE) and path.suffix == ROS1_SUFFIX
    return is_ros1 or head.startswith(tuple(STORAGE_SIGNATURES.values()))


def _verify_file(file: Path) -> mcap_checksums.ChecksumCoverage:
    """Verify signature and checksums of one storage file; returns what its checksums cover."""
    with file.open("rb") as opened:
        head = opened.read(16)
    kind = next((suffix for suffix, magic in STORAGE_SIGNATURES.items() if head.startswith(magic)), None)
    if kind != file.suffix:
        got = f"content of a {kind} file" if kind else repr(head[:8])
        raise RecordingError(f"{file} is mislabelled", got=got, expected=f"{file.suffix} content", remedy="rename it")
    if kind == ".mcap":
        with report_damage(file, "MCAP file"):
            return mcap_checksums.verify_checksums(file)
    _check_sqlite(file)
    return "none"


def _check_sqlite(file: Path) -> None:
    import sqlite3

    place = str(file.resolve())
    if re.search("[#?]|%[0-9a-fA-F]{2}", place):  # rosbags, too, would cut the path there
        got, expected = "a path with #, ? or % in it", "one that stands for itself in a URI"
        raise RecordingError(f"{file} cannot be opened", got=got, expected=expected, remedy="rename the folder")
    for suffix in ("-wal", "-journal"):  # these files are not read
        journal = file.with_name(file.name + suffix)
        if journal.is_file() and journal.stat().st_size:
            remedy = f"open and close it once with sqlite3, which takes in {journal.name}, or reindex the bag"
            raise RecordingError(f"{file} is unfinished", got=f"messages in {journal.name}", remedy=remedy)
    with report_damage(file, "sqlite3 file"):
        connection = sqlite3.connect(f"file:{place}?immutable=1", uri=True)
        try:
            computed = connection.execute(COMPUTED_TABLES_QUERY).fetchone()
            if computed is not None:
                got, expected = f"{computed[0]} {computed[1]!r}", "tables only, as recorders write them"
                raise RecordingError(f"{file} is no sound sqlite3 file", got=got, expected=expected)
            report = connection.execute("PRAGMA integrity_check").fetchone()[0]
        finally:
            connection.close()
    if report != "ok":
        raise RecordingError(f"{file} is damaged", got=report[:200], remedy="copy or record it again")
