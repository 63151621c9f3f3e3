"""An episode becomes one MCAP file of standard messages and comes back the same."""

from __future__ import annotations

import shutil
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import foreign_formats
from helpers import mcap_files as mcap_truth

from torchcloth import recordings as rec
from torchcloth.errors import RecordingError
from torchcloth.recordings import formats
from torchcloth.recordings.formats import mcap_checksums

FOXGLOVE = Path(__file__).parent / "mcap"
NANO = 1e-9 / 2 + 1e-16  # times are rounded to whole nanoseconds


def without_source(recording: rec.Recording) -> rec.Recording:
    return replace(recording, extra={k: v for k, v in recording.extra.items() if k != "source"})


def test_episode_to_mcap_and_back(episode, tmp_path, assert_same):
    original = rec.read(episode, with_truth=True)
    file = formats.write_mcap(original, tmp_path / "ep.mcap")
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith(".")] == []
    back = rec.read(rec.write(formats.read(file), tmp_path / "back"), with_truth=True)
    assert_same(original, without_source(back), times=NANO)
    assert back.extra["source"]["checksums"] == "all bytes"


def test_keys_and_notes_of_ones_own_come_back(recording, tmp_path):
    """A slash in a key made it another stream's: raw/xyz took the place of xyz."""
    points = replace(recording.points, extra={"raw/xyz": np.full((2, 3), 9.0), "raw/t": np.array([0.1, 0.2])})
    left = replace(recording.grippers["left"], extra={"raw/ft": np.arange(6.0)})
    grippers, extra = recording.grippers | {"left": left}, recording.extra | {"source": "lab 3"}
    ours = replace(recording, points=points, grippers=grippers, extra=extra)
    back = formats.read(formats.write_mcap(ours, tmp_path / "ep.mcap"))
    np.testing.assert_array_equal(back.points.xyz, points.xyz)
    np.testing.assert_array_equal(back.points.extra["raw/xyz"], points.extra["raw/xyz"])
    np.testing.assert_array_equal(back.grippers["left"].extra["raw/ft"], np.arange(6.0))
    assert back.extra["source"]["origin"] == "lab 3"


def test_what_is_wrong_with_a_whole_stream_of_images_is_said(episode, tmp_path):
    """At its end, behind the last image that has a time: as `write` says it of a folder."""
    recording = rec.read(episode)
    (name, camera), *_ = recording.cameras.items()
    more = replace(camera.depth, paths=(*camera.depth.paths, camera.depth.paths[0]))
    longer = replace(recording, cameras=recording.cameras | {name: replace(camera, depth=more)})
    for write in (
        lambda: rec.write(longer, tmp_path / "folder"),
        lambda: formats.write_mcap(longer, tmp_path / "ep.mcap"),
    ):
        with pytest.raises(RecordingError, match="depth images are too many"):
            write()
    assert list(tmp_path.glob("*.mcap")) == []


def test_times_that_no_stamp_holds_are_refused_without_a_trace(recording, tmp_path):
    late = replace(recording, points=replace(recording.points, t=recording.points.t + 3e9))
    with pytest.raises(RecordingError, match=r"end in 2038; got a time of 3e\+09 s; .*begin at 0 s"):
        formats.write_mcap(late, tmp_path / "new" / "deep" / "ep.mcap")
    assert not (tmp_path / "new").exists()


def test_an_imported_bag_keeps_its_absolute_times(tmp_path):
    truth = foreign_formats.write_ros2(tmp_path)
    imported = formats.read(truth.path, scene=truth.write_scene())
    file = formats.write_mcap(imported, tmp_path / "again.mcap")
    back = formats.read(file)
    assert back.extra["source"]["start_ns"] == foreign_formats.FIRST_STAMP_NS
    assert back.extra["source"]["origin"] == imported.extra["source"]
    np.testing.assert_array_equal(back.points.xyz, imported.points.xyz)
    np.testing.assert_array_equal(back.grippers["left"].t, imported.grippers["left"].t)
    for kind in ("depth", "color"):
        ours, theirs = getattr(back.cameras["cam1"], kind), getattr(imported.cameras["cam1"], kind)
        np.testing.assert_array_equal(ours.load(2), theirs.load(2))


def test_rosbags_itself_reads_the_standard_messages(recording, tmp_path):
    from rosbags.highlevel import AnyReader

    file = formats.write_mcap(recording, tmp_path / "ep.mcap")
    with AnyReader([file]) as reader:
        kinds = {c.topic: c.msgtype for c in reader.connections}
        logged = [ns for _, ns, _ in reader.messages()]
        pose = [reader.deserialize(raw, c.msgtype).pose for c, _, raw in reader.messages() if c.topic == "/left/pose"]
    assert kinds["/left/pose"] == "geometry_msgs/msg/PoseStamped"
    assert kinds["/points"] == "sensor_msgs/msg/PointCloud2"
    assert kinds["/cam0/depth"] == "sensor_msgs/msg/CompressedImage"
    assert logged == sorted(logged)
    quat = recording.grippers["left"].quat_wxyz[0]
    np.testing.assert_array_equal([getattr(pose[0].orientation, k) for k in "wxyz"], quat)


@pytest.mark.parametrize(("name", "cover"), [("chunk_crcs", "messages"), ("all_crcs", "all bytes")])
def test_a_file_of_the_mcap_project_is_read(tmp_path, name, cover):
    file = Path(shutil.copy(FOXGLOVE / f"{name}.mcap", tmp_path))
    scene = {**foreign_formats.SCENE_DESCRIPTION, "source": {"motion": {"hand": {"pose": "/hand", "closed": True}}}}
    recording = formats.read(file, scene=foreign_formats.ForeignRecording(file, scene).write_scene())
    np.testing.assert_array_equal(
        recording.grippers["hand"].position, [mcap_truth.gripper_position(i) for i in range(5)]
    )
    np.testing.assert_array_equal(recording.grippers["hand"].t, np.arange(5) / 50)
    assert recording.extra["source"]["checksums"] == cover


def test_our_checksums_are_those_of_the_mcap_project(tmp_path):
    """Sealing the file without one of its data gives the bytes of the file with it; then any change is noticed."""
    file = Path(shutil.copy(FOXGLOVE / "chunk_crcs.mcap", tmp_path))
    mcap_checksums.write_checksums(file)
    whole = (FOXGLOVE / "all_crcs.mcap").read_bytes()
    assert file.read_bytes() == whole
    for at in range(len(whole)):
        file.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
        with pytest.raises((RecordingError, struct.error)):
            mcap_checksums.verify_checksums(file)


def test_an_existing_file_is_kept(recording, tmp_path):
    file = formats.write_mcap(recording, tmp_path / "ep.mcap")
    before = file.read_bytes()
    with pytest.raises(RecordingError, match="exists"):
        formats.write_mcap(recording, file)
    left = recording.grippers["left"]
    broken = replace(recording, grippers={**recording.grippers, "left": replace(left, t=left.t[::-1])})
    with pytest.raises(
        RecordingError, match=r"ep\.mcap: /torchcloth/scene: source.motion.left: /left/closed begins late"
    ):
        formats.write_mcap(broken, file, overwrite=True)
    assert file.read_bytes() == before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["ep.mcap", "images"]
