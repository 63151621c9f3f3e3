"""Folders of ``.pcd`` clouds and captures of RGBench: encodings, times, places, and refusals of damage."""

from __future__ import annotations

import json
import struct

import numpy as np
import pytest
from helpers import foreign_formats

from torchcloth.errors import RecordingError
from torchcloth.recordings import formats
from torchcloth.recordings.formats.pcd_file import parse_pcd
from torchcloth.recordings.formats.pose_log import read_pose_log

HEADER = {
    "VERSION": "0.7",
    "FIELDS": "rgb x y z normal",
    "SIZE": "4 8 4 4 4",
    "TYPE": "U F F F F",
    "COUNT": "1 1 1 1 3",
    "WIDTH": "2",
    "HEIGHT": "1",
    "VIEWPOINT": "0 0 0 1 0 0 0",
    "POINTS": "2",
}
POINTS = np.array([[0.125, -0.25, 0.5], [1.0, 2.0, -3.0]])


def pcd(encoding: str, body: bytes, **changes: str | None) -> bytes:
    lines = [f"{key} {value}" for key, value in {**HEADER, **changes}.items() if value is not None]
    return "\n".join(["# .PCD v0.7", *lines, f"DATA {encoding}", ""]).encode() + body


RECORDS = b"".join(struct.pack("<Idff3f", 7, *point, 0, 0, 1) for point in POINTS.tolist())
TEXT = b"7 0.125 -0.25 0.5 0 0 1\n7 1 2 -3 0 0 1\n"


@pytest.mark.parametrize(("encoding", "body"), [("ascii", TEXT), ("binary", RECORDS)])
def test_other_fields_of_any_size_are_skipped(encoding, body):
    np.testing.assert_array_equal(parse_pcd(pcd(encoding, body), "a.pcd"), POINTS)
    np.testing.assert_array_equal(parse_pcd(pcd(encoding, body, POINTS=None), "a.pcd"), POINTS)


def test_points_without_a_reading_are_left_out():
    body = b"7 nan nan nan 0 0 1\n7 0 0 0 0 0 1\n7 1 2 -3 0 0 1\n"
    np.testing.assert_array_equal(parse_pcd(pcd("ascii", body, WIDTH="3", POINTS="3"), "a.pcd"), POINTS[1:])
    assert parse_pcd(pcd("ascii", b"", WIDTH="0", POINTS="0"), "a.pcd").shape == (0, 3)


def test_compressed_clouds_of_open3d_are_read(tmp_path):
    """Rows that repeat are packed as references, also into what they write; noise is packed as literals."""
    rng = np.random.default_rng(0)
    for cloud in (np.full((700, 3), 0.5), np.tile(rng.normal(size=(9, 3)), (90, 1)), rng.normal(size=(200, 3))):
        foreign_formats.write_cloud(tmp_path / "a.pcd", cloud.astype(np.float32), compressed=True)
        np.testing.assert_array_equal(parse_pcd((tmp_path / "a.pcd").read_bytes(), "a.pcd"), cloud.astype(np.float32))


BOMB = struct.pack("<II", 8, 2**31) + bytes(8)
DAMAGED = {
    "more points than bytes": (pcd("binary", RECORDS, WIDTH="999999999999", POINTS="999999999999"), "bytes of points"),
    "a size beyond any file": (pcd("binary", RECORDS, COUNT="1 1 1 1 999999999999999"), "bytes of points"),
    "cut off": (pcd("binary", RECORDS[:-1]), "63 bytes of points; expected 64"),
    "a row lost": (pcd("ascii", TEXT[: TEXT.index(b"\n") + 1]), "got 1 rows; expected 2 points"),
    "no number": (pcd("ascii", TEXT.replace(b"2", b"two")), "is no sound .pcd file"),
    "two numbers of points": (pcd("binary", RECORDS, POINTS="3"), "expected one number of points"),
    "no x": (pcd("binary", RECORDS, FIELDS="rgb a y z normal"), "x, y and z once each"),
    "whole numbers": (pcd("binary", RECORDS, TYPE="U I F F F"), "of type F and size 4 or 8"),
    "a type lost": (pcd("binary", RECORDS, TYPE="U F F F"), "5 fields, 5 sizes, 4 types, 5 counts"),
    "negative": (pcd("binary", RECORDS, SIZE="4 -8 4 4 4"), "whole numbers of at least 1"),
    "unknown encoding": (pcd("zip", RECORDS), "expected DATA ascii or binary or binary_compressed"),
    "no end of the header": (b"# .PCD v0.7\nVERSION 0.7\n" + bytes(9000), "expected a header with lines"),
    "a key twice": (pcd("binary", RECORDS).replace(b"HEIGHT", b"WIDTH"), "expected a header"),
    "packed, cut off": (pcd("binary_compressed", struct.pack("<II", 99, 64) + bytes(9)), "64 bytes of points"),
    "packed, damaged": (
        pcd("binary_compressed", struct.pack("<II", 3, 64) + b"\xff\xff\xff"),
        "0 bytes after unpacking",
    ),
    "packed bomb": (
        pcd("binary_compressed", BOMB, FIELDS="x y z", SIZE="4 4 4", TYPE="F F F", COUNT=None, POINTS=None)
        .replace(b"WIDTH 2", b"WIDTH 178956971")
        .replace(struct.pack("<I", 2**31), struct.pack("<I", 12 * 178956971)),
        "unpacks to too much",
    ),
    "text": (b"hello", "expected a header with lines"),
    "empty": (b"", "expected a header with lines"),
}


@pytest.mark.parametrize("case", DAMAGED)
def test_a_damaged_cloud_is_refused_by_one_line(case):
    data, match = DAMAGED[case]
    with pytest.raises(RecordingError, match=match) as caught:
        parse_pcd(data, "a.pcd")
    assert "\n" not in str(caught.value)


@pytest.fixture
def folder(tmp_path):
    return foreign_formats.write_pcd(tmp_path)


def read(truth: foreign_formats.ForeignRecording):
    return formats.read(truth.path, scene=truth.write_scene())


def test_times_may_be_in_the_names(folder):
    (folder.path / "stamps.csv").unlink()
    folder.scene["source"] = {}
    (folder.path / "hand.csv").unlink()
    with pytest.raises(RecordingError, match=r"gives no times of its clouds; got names such as cloud_0\.pcd"):
        read(folder)
    for path, stamp in zip(sorted(folder.path.glob("*.pcd")), ("1.5", "1.75", "1.625"), strict=True):
        path.rename(path.with_name(f"pointcloud_{stamp}_segmented.pcd"))
    points = read(folder).points
    np.testing.assert_array_equal(points.t, [0, 0.125, 0.25])
    np.testing.assert_array_equal(points.counts, [4, 6, 5])


def test_points_are_placed_by_the_scene(folder):
    whole = read(folder).points.xyz
    source = folder.scene["source"]
    source["T_world_points"] = foreign_formats.CAMERA_POSE
    pose = np.array(foreign_formats.CAMERA_POSE)
    np.testing.assert_allclose(read(folder).points.xyz, whole @ pose[:3, :3].T + pose[:3, 3], atol=1e-15)
    source["frame"] = "cam0"
    with pytest.raises(RecordingError, match="frame and T_world_points; got both; expected one of them"):
        read(folder)
    del source["T_world_points"]
    camera = {"width": 640, "height": 480, "K": [[600.0, 0, 320], [0, 600, 240], [0, 0, 1]]}
    folder.scene["cameras"] = {"cam0": {**camera, "T_world_camera": foreign_formats.CAMERA_POSE}}
    np.testing.assert_allclose(read(folder).points.xyz, whole @ pose[:3, :3].T + pose[:3, 3], atol=1e-15)


def test_poses_turn_with_the_base_of_their_arm(folder):
    from scipy.spatial.transform import Rotation

    hand = read(folder).grippers["left"]
    folder.scene["robots"] = {"left": {"model": "rizon4", "T_world_base": foreign_formats.CAMERA_POSE}}
    folder.scene["source"]["motion"]["left"]["frame"] = "left"
    pose = np.array(foreign_formats.CAMERA_POSE)
    placed = read(folder).grippers["left"]
    np.testing.assert_allclose(placed.position, hand.position @ pose[:3, :3].T + pose[:3, 3], atol=1e-15)
    turned = Rotation.from_matrix(pose[:3, :3]) * Rotation.from_quat(hand.quat_wxyz, scalar_first=True)
    assert (turned * Rotation.from_quat(placed.quat_wxyz, scalar_first=True).inv()).magnitude().max() < 1e-12


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"times": "../stamps.csv"}, "source.times leaves the folder"),
        ({"times": "none.csv"}, "source.times names no file"),
        ({"time_unit": "hours"}, "time_unit is unknown; got 'hours'; expected one of s, ms, us, ns"),
        (
            {"motion": {}},
            r"holds several tables; got hand.csv, stamps.csv; expected one; write .*\"times\": \"hand.csv",
        ),
        ({"motion": {"left": {"file": "hand.csv"}}}, "closed is missing"),
        ({"motion": {"left": {"file": "hand.csv", "closed": 1}}}, "closed is unclear; got 1"),
        (
            {"motion": {"left": {"file": "stamps.csv", "closed": True}}},
            "holds no poses; got 0 columns; expected one column",
        ),
        ({"stamps": "stamps.csv"}, "source.stamps is unknown"),
    ],
)
def test_a_source_that_does_not_fit(folder, change, match):
    folder.scene["source"] |= change
    with pytest.raises(RecordingError, match=match):
        read(folder)


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ("cloud_0", "cloud_9", "stamps.csv does not fit the clouds; got no time of cloud_0.pcd"),
        ("328.310000", "328.250000", "two clouds have one time; got cloud_.*"),
        (",cloud_0.pcd", ",", "stamps.csv does not fit the clouds|is no table"),
    ],
)
def test_a_table_that_does_not_fit_the_clouds(folder, old, new, match):
    path = folder.path / "stamps.csv"
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(RecordingError, match=match):
        read(folder)


def test_an_empty_cloud_is_left_out_with_a_note(folder):
    (folder.path / "cloud_0.pcd").write_bytes(pcd("ascii", b"", WIDTH="0", POINTS="0"))
    recording = read(folder)
    assert len(recording.points) == 2
    assert "1 of 3 clouds have no point and are left out" in recording.extra["source"]["repairs"]


def test_a_single_sample_that_jumps_is_left_out(tmp_path):
    position = np.linspace([0, 0, 0], [0.1, 0, 0], 20)
    position[7] += [0, 0, 0.4]
    quat = np.tile([1.0, 0, 0, 0], (20, 1))
    foreign_formats.write_poses(tmp_path / "a.csv", [f"{k / 100}" for k in range(20)], position, quat)
    log = read_pose_log(tmp_path / "a.csv", "s")
    np.testing.assert_array_equal(log.position, np.delete(position, 7, axis=0))
    assert log.notes == ("a.csv: 1 of 20 samples jump to and fro and are left out",)


def test_times_of_ros_in_two_columns_and_its_names_are_read(tmp_path):
    heads = "header.stamp.secs,header.stamp.nsecs,name,position,pose.position.x,pose.position.y,pose.position.z"
    heads += ",pose.orientation.x,pose.orientation.y,pose.orientation.z,pose.orientation.w"
    rows = [f'17,{5000000 * k},"[\'joint1\']","[0.1, 0.2]",1,2,{3 + k},0,0,0,1' for k in range(4)]
    (tmp_path / "a.csv").write_text("\n".join([heads, *rows]))
    log = read_pose_log(tmp_path / "a.csv")
    np.testing.assert_array_equal(log.ns, 17 * 10**9 + 5_000_000 * np.arange(4))
    np.testing.assert_array_equal(log.position, [[1, 2, 3 + k] for k in range(4)])
    np.testing.assert_array_equal(log.quat_wxyz, [[1, 0, 0, 0]] * 4)


def test_one_cloud_alone_says_what_to_pass(folder):
    with pytest.raises(RecordingError, match=r"got a point cloud \(PCD\); .*pass the folder of the clouds"):
        formats.read(folder.path / "cloud_0.pcd")


@pytest.fixture
def capture(tmp_path):
    return foreign_formats.write_rgbench(tmp_path)


def test_the_clouds_decide_where_the_arms_stand(capture):
    """The benchmark's documentation and its program exchange the bases."""
    assert "left arm at y = +0.25 m" in read(capture).extra["source"]["repairs"][-1]
    left, right = (capture.path / "joints" / f"{arm}_arm_joint_states_and_end_pose.csv" for arm in ("left", "right"))
    files = left.read_text(), right.read_text()
    left.write_text(files[1])
    right.write_text(files[0])
    recording = read(capture)
    assert "left arm at y = -0.25 m" in recording.extra["source"]["repairs"][-1]
    np.testing.assert_array_equal(recording.grippers["left"].position, capture.arrays["right/position"])
    bases = {arm: np.eye(4).tolist() for arm in ("left", "right")}
    capture.scene["source"] = {"T_world_base": bases}
    moved = read(capture).grippers["right"].position
    np.testing.assert_allclose(moved, capture.arrays["left/position"] - [0, 0.25, 0], atol=1e-15)
    del bases["left"]
    with pytest.raises(RecordingError, match=r"T_world_base\.left is missing"):
        read(capture)


def test_delay_and_grasp_of_a_capture(capture):
    capture.scene["source"] = {"camera_delay": 0.03, "held_from": 0.1}
    recording = read(capture)
    np.testing.assert_allclose(recording.points.t, [0.03, 0.09, 0.1525], atol=1e-12)
    np.testing.assert_array_equal(recording.grippers["left"].closed, np.arange(8) >= 4)
    assert any(note.startswith("30.0 ms are added") for note in recording.extra["source"]["repairs"])
    capture.scene["source"] = {"camera_delay": 60}
    with pytest.raises(RecordingError, match="camera_delay looks like milliseconds"):
        read(capture)


@pytest.mark.parametrize(
    ("content", "match"),
    [
        ("[[1, 0], [0, 1]]", "wrong shape; got .*; expected"),
        ("{}", "wrong dtype|wrong shape"),
        ("[[", "is not valid JSON"),
        (json.dumps((2 * np.eye(4)).tolist()), "is not a rotation"),
        (None, "cannot be read"),
    ],
)
def test_a_calibration_that_is_none(capture, content, match):
    path = capture.path / "calibration" / "world_to_camera_transform.json"
    path.unlink() if content is None else path.write_text(content)
    with pytest.raises(RecordingError, match=match):
        read(capture)


def test_a_capture_without_arms(capture):
    for path in (capture.path / "joints").iterdir():
        path.unlink()
    with pytest.raises(
        RecordingError, match=r"holds no arm; expected left_arm_joint_states_and_end_pose\.csv or right_arm"
    ):
        read(capture)
    (capture.path / "joints").rmdir()
    with pytest.raises(RecordingError, match="a capture of RGBench needs joints beside segment_pcds"):
        read(capture)
