"""Files made to do harm: they fill no memory, open no other file, and are refused in one line."""

from __future__ import annotations

import bz2
import json
import re
import shutil
import sqlite3
import struct
import time
import tracemalloc
from contextlib import closing
from pathlib import Path
from zlib import crc32

import numpy as np
import pytest
from helpers import foreign_formats

from torchcloth import recordings as rec
from torchcloth.errors import MissingDependency, RecordingError
from torchcloth.recordings import formats
from torchcloth.recordings.formats import bounded_decompression
from torchcloth.recordings.images import PNG_SIGNATURE

pytest.importorskip("rosbags")
BOMB_BYTES = 400 << 20
MAX_PEAK_BYTES = 200 << 20


def make_bomb(compressor) -> bytes:
    """Zeros of 400 MB in a few kilobytes."""
    block = bytes(1 << 22)
    pieces = [compressor.compress(block) for _ in range(BOMB_BYTES // len(block))]
    return b"".join([*pieces, compressor.flush()])


@pytest.fixture(scope="module")
def zstd_bomb() -> bytes:
    from rosbags.rosbag2 import storage_mcap

    return make_bomb(storage_mcap.zstd.ZstdCompressor())


def refuse_with_little_memory(call, match="unpacks to too much"):
    tracemalloc.start()
    try:
        with pytest.raises(RecordingError, match=match) as caught:
            call()
        assert tracemalloc.get_traced_memory()[1] < MAX_PEAK_BYTES
    finally:
        tracemalloc.stop()
    assert "\n" not in str(caught.value)


def read(truth: foreign_formats.ForeignRecording) -> rec.Recording:
    return formats.read(truth.path, scene=truth.write_scene(), **truth.options)


def set_compression(bag: Path, mode: str, rename=lambda name: name) -> None:
    """Say in a bag's metadata that it is compressed."""
    text = re.sub("compression_format:.*", "compression_format: zstd", (bag / "metadata.yaml").read_text())
    text = re.sub("compression_mode:.*", f"compression_mode: {mode.upper()}", text)
    (bag / "metadata.yaml").write_text(text.replace("bag_sqlite3.db3", rename("bag_sqlite3.db3")))


def test_a_message_that_unpacks_to_gigabytes(zstd_bomb, tmp_path):
    truth = foreign_formats.write_ros2(tmp_path, "sqlite3")
    with closing(sqlite3.connect(truth.path / "bag_sqlite3.db3")) as database:
        database.execute("update messages set data=?", (zstd_bomb,))
        database.commit()
    set_compression(truth.path, "message")
    refuse_with_little_memory(lambda: read(truth))


def test_a_storage_file_that_unpacks_to_gigabytes(zstd_bomb, tmp_path):
    truth = foreign_formats.write_ros2(tmp_path, "sqlite3")
    (truth.path / "bag_sqlite3.db3").unlink()
    (truth.path / "bag_sqlite3.db3.zstd").write_bytes(zstd_bomb)
    set_compression(truth.path, "file", lambda name: f"{name}.zstd")
    refuse_with_little_memory(lambda: read(truth), "bag_sqlite3.db3.zstd unpacks to too much")


def test_a_compressed_bag_is_read(tmp_path):
    truth = foreign_formats.write_ros2(tmp_path, "sqlite3")
    expected = read(truth)
    from rosbags.rosbag2 import storage_mcap

    with closing(sqlite3.connect(truth.path / "bag_sqlite3.db3")) as database:
        for number, data in database.execute("select id, data from messages").fetchall():
            database.execute("update messages set data=? where id=?", (storage_mcap.zstd.compress(data), number))
        database.commit()
    set_compression(truth.path, "message")
    np.testing.assert_array_equal(read(truth).grippers["left"].position, expected.grippers["left"].position)


def test_messages_that_are_computed_without_end(tmp_path):
    truth = foreign_formats.write_ros2(tmp_path, "sqlite3")
    endless = "with recursive n(i) as (select 1 union all select i + 1 from n)"
    with closing(sqlite3.connect(truth.path / "bag_sqlite3.db3")) as database:
        database.execute("alter table messages rename to stored")
        database.execute(f"create view messages as {endless} select stored.* from stored, n")
        database.commit()
    with pytest.raises(RecordingError, match="got view 'messages'; expected tables only"):
        read(truth)


def test_a_chunk_that_unpacks_to_more_than_it_declares(zstd_bomb):
    from rosbags.rosbag2 import storage_mcap

    bounded_decompression.limit_rosbags()
    refuse_with_little_memory(lambda: storage_mcap.decompress(zstd_bomb, "zstd", 1000, 0))


def test_a_chunk_of_ros1_that_unpacks_to_gigabytes(monkeypatch):
    from lz4 import frame
    from rosbags.rosbag1 import reader

    monkeypatch.setenv("TORCHCLOTH_MAX_UNPACKED_GIB", "0.05")  # lz4 cannot reach 200 times the file by much
    bomb = frame.compress(bytes(BOMB_BYTES))
    bounded_decompression.limit_rosbags()
    refuse_with_little_memory(lambda: reader.decompressors["lz4"](bomb))
    assert reader.decompressors["bz2"](bz2.compress(b"one")) == b"one"


def test_a_rosbags_that_cannot_be_limited_is_not_used(monkeypatch):
    def fail():
        raise AttributeError("DECOMPRESSORS")

    monkeypatch.setattr(bounded_decompression, "_replace_decompressors", fail)
    with pytest.raises(MissingDependency, match="another version of rosbags; pip install --upgrade"):
        bounded_decompression.limit_rosbags.__wrapped__()


@pytest.mark.parametrize("name", ["lz4", "zstd"])
def test_frames_one_after_the_other_are_unpacked(name):
    from lz4 import frame
    from rosbags.rosbag2 import storage_mcap

    bounded_decompression.limit_rosbags()
    compress = frame.compress if name == "lz4" else storage_mcap.zstd.compress
    assert storage_mcap.decompress(compress(b"one ") + compress(b"two"), name, 7, 0) == b"one two"
    with pytest.raises(EOFError):
        storage_mcap.decompress(compress(bytes(1000))[:-5], name, 1000, 0)


@pytest.fixture
def lerobot(tmp_path) -> foreign_formats.ForeignRecording:
    pytest.importorskip("pyarrow")
    return foreign_formats.copy_lerobot(tmp_path)


def test_a_video_that_is_a_playlist_opens_no_other_file(lerobot):
    """FFmpeg tells a playlist by its first line, whatever the file is called."""
    (video,) = lerobot.path.rglob("*.mp4")
    shutil.copy(video, video.with_name("other.mp4"))
    video.write_text("ffconcat version 1.0\nfile 'other.mp4'\n")
    with pytest.raises(RecordingError, match="is no sound video"):
        read(lerobot).cameras["cam0"].color.load(0)  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("template", "match"),
    [
        ("../{chunk_index}.parquet", "leaves the data set"),
        ("/etc/passwd", "leaves the data set"),
        ("{chunk_index:>9999999999}", "is no path template"),
        ("{chunk_index.__class__}", "is no path template"),
    ],
)
def test_a_path_template_stays_in_the_data_set_and_is_short(lerobot, template, match):
    file = lerobot.path / "meta/info.json"
    info = json.loads(file.read_text())
    info["data_path"] = template
    file.write_text(json.dumps(info))
    with pytest.raises(RecordingError, match=match):
        read(lerobot)


def test_a_table_of_equal_numbers_fills_no_memory(lerobot):
    """Ten million equal numbers take no space in a parquet file."""
    import pyarrow
    from pyarrow import parquet

    (file,) = (lerobot.path / "data").rglob("*.parquet")
    parquet.write_table(pyarrow.table({"episode_index": np.zeros(10_000_000, dtype=np.int64)}), file)
    with pytest.raises(RecordingError, match="unpacks to too much"):
        read(lerobot)


def test_an_image_that_unpacks_to_gigabytes(tmp_path):
    """Pillow refuses more than 179 million pixels."""
    file = tmp_path / "000000.png"
    head = b"IHDR" + struct.pack(">IIBBBBB", 20_000, 20_000, 1, 0, 0, 0, 0)
    parts = (struct.pack(">I", len(part) - 4) + part + struct.pack(">I", crc32(part)) for part in (head, b"IDAT"))
    file.write_bytes(PNG_SIGNATURE + b"".join(parts))
    stream = rec.ImageStream("mask", np.array([0]), np.array([0.0]), (file,), (20_000, 20_000))
    with pytest.raises(RecordingError, match="cannot be decoded; got DecompressionBomb"):
        stream.load(0)


def test_a_yaml_of_many_references_is_refused_at_once(tmp_path):
    """References to references: nine lines stand for a billion values."""
    truth = foreign_formats.write_ros2(tmp_path)
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 10)]
    text = (truth.path / "metadata.yaml").read_text()
    (truth.path / "metadata.yaml").write_text("\n".join(lines) + "\n" + text)
    started = time.monotonic()
    read(truth)  # references are shared, so they cost nothing
    assert time.monotonic() - started < 10
