"""Mislabelled, contradictory or incomplete files are refused in one line that names the remedy."""

from __future__ import annotations

import json
import re
import shutil
import sqlite3
from types import SimpleNamespace

import numpy as np
import pytest
from helpers import foreign_formats
from PIL import Image

from torchcloth import recordings as rec
from torchcloth.errors import InvalidInput, RecordingError
from torchcloth.recordings import formats
from torchcloth.recordings.formats import bag, lerobot
from torchcloth.recordings.formats.bag import BagMessage
from torchcloth.recordings.formats.imported import parse_nanoseconds
from torchcloth.recordings.formats.ros2_cameras import BagImages


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Each format once, to be copied."""
    return {name: write(tmp_path_factory.mktemp(name)) for name, write in foreign_formats.WRITERS.items()}


@pytest.fixture
def copy(written, tmp_path):
    """A function that copies one format here and gives its scene to be changed."""

    def make(name: str) -> foreign_formats.ForeignRecording:
        truth = written[name]
        target = tmp_path / truth.path.name
        (shutil.copytree if truth.path.is_dir() else shutil.copy)(truth.path, target)
        scene = json.loads(json.dumps(truth.scene))
        return foreign_formats.ForeignRecording(
            target, scene, truth.images, truth.times, truth.arrays, dict(truth.options)
        )

    return make


def refuse(truth: foreign_formats.ForeignRecording, match: str, **options):
    with pytest.raises((RecordingError, InvalidInput), match=match) as caught:
        formats.read(truth.path, scene=truth.write_scene(), **{**truth.options, **options})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", foreign_formats.WRITERS)
def test_without_a_scene_it_says_what_to_write(name, copy):
    truth = copy(name)
    remaining = {key: value for key, value in truth.scene.items() if key in ("source", "cameras")}
    truth.scene = remaining
    refuse(
        truth, r'does not contain everything; expected .*"cloth": \{"sheet".*"areal_density".*"provenance": "measured"'
    )


@pytest.mark.parametrize("name", ["tum", "ros2", "lerobot", "kinect"])
def test_without_a_camera_pose_it_says_what_to_write(name, copy):
    truth = copy(name)
    for camera in truth.scene["cameras"].values():
        camera.pop("T_world_camera", None)
    if name == "tum":
        (truth.path / "groundtruth.txt").unlink()
    refuse(truth, r'"cameras": \{"\w+": \{"T_world_camera": \[\[1,0,0,0\]')


@pytest.mark.parametrize("name", foreign_formats.WRITERS)
def test_another_name_is_refused(name, copy):
    other = "tum" if name != "tum" else "redwood"
    refuse(copy(name), f"mislabelled; got content of {name}; expected {other}", format=other)


def test_an_unknown_format_is_refused(copy):
    refuse(copy("tum"), "format is unknown; got 'bag'", format="bag")


@pytest.mark.parametrize(
    ("head", "what"),
    [
        (b"\x00\x00\x00\x20ftypisom", "an MP4 video"),
        (b"PAR1....", "a parquet file"),
        (b"#ROSBAG V2.0", "a ROS 1 bag"),
        (b"", "b''"),
        (b"hello world", "b'hello wo'"),
    ],
)
def test_a_file_of_no_known_format(tmp_path, head, what):
    file = tmp_path / "take.mkv"
    file.write_bytes(head)
    with pytest.raises(RecordingError, match=f"no known format; got {what}"):
        formats.read(file)
    with pytest.raises(RecordingError, match="does not exist"):
        formats.read(tmp_path / "nothing")


def test_an_mcap_file_with_another_suffix(copy):
    truth = copy("ros2")
    file = truth.path / "take.db3"
    (truth.path / f"{truth.path.name}.mcap").rename(file)
    truth.path = file
    refuse(truth, "mislabelled; got content of a .mcap file; expected .db3 content")


@pytest.mark.parametrize("suffix", ["-wal", "-journal"])
def test_messages_that_are_not_in_the_bag_yet_are_not_lost(tmp_path, suffix):
    """Of a recorder that was killed: the end of the recording is beside the file, which is sound by itself."""
    file = tmp_path / "take_0.db3"
    connection = sqlite3.connect(file)
    connection.execute("CREATE TABLE topics(id INTEGER)")
    connection.commit()
    connection.close()
    bag._check_sqlite(file)
    adjacent = tmp_path / f"take_0.db3{suffix}"
    adjacent.write_bytes(b"")
    bag._check_sqlite(file)
    adjacent.write_bytes(b"more")
    with pytest.raises(RecordingError, match=rf"unfinished; got messages in take_0\.db3{suffix}; .*sqlite3"):
        bag._check_sqlite(file)


def test_a_camera_that_contradicts_the_file(copy):
    truth = copy("redwood")
    truth.scene["cameras"] = {"cam0": {"K": [[14.0, 0, 7.5], [0, 16.0, 5.25], [0, 0, 1]]}}
    refuse(truth, "cameras.cam0.K contradicts the file")
    truth.scene["cameras"]["cam0"]["K"][1][1] = 15.0001  # rounding
    recording = formats.read(truth.path, scene=truth.write_scene())
    np.testing.assert_array_equal(recording.cameras["cam0"].K, [[14, 0, 7.5], [0, 15, 5.25], [0, 0, 1]])


def test_a_row_major_intrinsic(copy):
    truth = copy("redwood")
    file = truth.path / "camera_intrinsic.json"
    message = json.loads(file.read_text())
    message["intrinsic_matrix"] = np.reshape(message["intrinsic_matrix"], (3, 3)).T.reshape(-1).tolist()
    file.write_text(json.dumps(message))
    refuse(truth, "is no camera matrix.*column by column")


def test_redwood_images_without_times(copy):
    truth = copy("redwood")
    for i, file in enumerate(sorted(truth.path.rglob("*.png"))):
        file.rename(file.with_name(f"{i % 3:06d}.png"))
    refuse(truth, 'carry no times; expected the scene with "source": {"fps": 30}')
    truth.scene["source"] = {"fps": 20}
    recording = formats.read(truth.path, scene=truth.write_scene())
    np.testing.assert_array_equal(recording.cameras["cam0"].depth.t, [0, 0.05, 0.1])
    truth.scene["source"] = {"fsp": 20}
    refuse(truth, "source.fsp is unknown")


def test_a_folder_of_open3ds_recorder(copy):
    """Its intrinsic file, in Open3D's own words, tells the rate and the depth scale."""
    import open3d as o3d

    truth = copy("redwood")
    for i, file in enumerate(sorted(truth.path.rglob("*.png"))):
        file.rename(file.with_name(f"{i % 3:05d}.png"))
    (truth.path / "camera_intrinsic.json").unlink()
    text = o3d.t.io.RGBDVideoMetadata()
    text.fps, text.width, text.height, text.depth_scale = (
        20.0,
        foreign_formats.IMAGE_WIDTH_PX,
        foreign_formats.IMAGE_HEIGHT_PX,
        4000.0,
    )
    text.intrinsics = o3d.camera.PinholeCameraIntrinsic(
        foreign_formats.IMAGE_WIDTH_PX, foreign_formats.IMAGE_HEIGHT_PX, 14.0, 15.0, 7.5, 5.25
    )
    (truth.path / "intrinsic.json").write_text(repr(text))
    camera = formats.read(truth.path, scene=truth.write_scene()).cameras["cam0"]
    np.testing.assert_array_equal(camera.depth.t, [0, 0.05, 0.1])
    assert camera.depth_scale == 1 / 4000
    truth.scene["source"] = {"fps": 30}
    refuse(truth, "source.fps contradicts the file; got 30.0; expected 20")


def test_depth_in_other_units(copy):
    truth = copy("redwood")
    truth.scene["cameras"] = {"cam0": {"depth_scale": 0.1}}
    refuse(truth, "units of 0.1 m; got a median depth of 1")


def test_tum_depth_in_other_units(copy):
    truth = copy("tum")
    camera = truth.scene["cameras"]["cam0"]
    camera["depth_scale"] = 0.1
    refuse(truth, "units of 0.1 m; got a median depth of 1")
    camera["depth_scale"] = 0.001
    assert formats.read(truth.path, scene=truth.write_scene()).cameras["cam0"].depth_scale == 0.001


def test_tum_depth_in_millimetres_is_not_read_as_a_fifth(copy):
    """1.0 m in millimetres was read as 0.2 m; who has a camera that near says so."""
    truth = copy("tum")
    for file in (truth.path / "depth").iterdir():
        Image.fromarray(np.full((12, 16), 1000, np.uint16)).save(file)
    refuse(
        truth,
        "unit of depth is unclear; got a median depth of 0.2 m, which would be 1 m in millimetres; "
        ".*depth_scale in the scene: 0.001 for millimetres, or 0.0002",
    )
    for scale in (0.001, 0.0002):
        truth.scene["cameras"]["cam0"]["depth_scale"] = scale
        camera = formats.read(truth.path, scene=truth.write_scene()).cameras["cam0"]
        assert camera.depth.load(0).max() * camera.depth_scale == pytest.approx(1000 * scale)


def test_masks_without_depth_keep_their_times(copy, tmp_path):
    """Times of the depth images, whose frame numbers colour has, too."""
    truth = copy("tum")
    episode = rec.write(formats.read(truth.path, scene=truth.write_scene()), tmp_path / "ep")
    depth, color = (getattr(rec.read(episode).cameras["cam0"], kind) for kind in ("depth", "color"))
    (episode / "cam0" / "depth").rename(episode / "cam0" / "mask")
    for again in ("once", "twice"):
        camera = rec.read(episode).cameras["cam0"]
        assert camera.depth is None
        np.testing.assert_array_equal(camera.mask.t, depth.t)
        np.testing.assert_array_equal(camera.color.t, color.t)
        episode = rec.write(rec.read(episode), tmp_path / again)


@pytest.mark.parametrize("name", ["run #3", "a?b", "50%25"])
def test_a_sqlite_bag_whose_path_is_another_in_a_uri(tmp_path, name):
    truth = foreign_formats.write_ros2(tmp_path / "plain", "sqlite3")
    truth.path = truth.path.rename(tmp_path / name)
    truth.write_scene()
    before = sorted(tmp_path.iterdir())
    refuse(truth, "cannot be opened; got a path with .*rename the folder")
    assert sorted(tmp_path.iterdir()) == before


def test_a_refused_conversion_leaves_no_folders(copy, tmp_path):
    truth = copy("tum")
    last = sorted((truth.path / "depth").iterdir())[-1]
    last.write_bytes(last.read_bytes()[:100])
    result = formats.read(truth.path, scene=truth.write_scene())
    with pytest.raises(RecordingError, match="cannot be decoded"):
        rec.write(result, tmp_path / "new" / "deep" / "ep")
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("time", ["1E9999999", "1e400", 400 * "9", "nan", "yesterday"])
def test_a_time_that_is_none(time):
    with pytest.raises(RecordingError, match="is no time"):
        parse_nanoseconds(time, "rgb.txt")


@pytest.mark.parametrize(("name", "file"), [("redwood", "trajectory.log"), ("tum", "groundtruth.txt")])
def test_a_moving_camera(copy, name, file):
    truth = copy(name)
    path = truth.path / file
    before = path.read_text()
    after = before.replace("0.50000000", "0.51000000", 1) if name == "redwood" else before.replace(" 0.5 ", " 0.51 ", 1)
    assert after != before
    path.write_text(after)
    refuse(truth, "moves; got 0.01 m and 0 degrees; expected a camera that stands still")


def test_tum_may_track_the_hand(copy):
    truth = copy("tum")
    truth.scene["cameras"]["cam0"]["T_world_camera"] = foreign_formats.CAMERA_POSE
    truth.scene["source"] = {"trajectory": "hand"}
    refuse(truth, "source.closed is unclear; expected true or false")
    truth.scene["source"]["closed"] = True
    hand = formats.read(truth.path, scene=truth.write_scene()).grippers["hand"]
    np.testing.assert_allclose(hand.t, 0.000496 + np.arange(10) / 100, atol=1e-12)
    np.testing.assert_array_equal(hand.position[0], [0.5, 0.1, 1.5])
    np.testing.assert_allclose(hand.quat_wxyz[0], [0.0, 0.5**0.5, 0.5**0.5, 0.0], atol=1e-15)  # its file has 8 digits


BASE = np.array([[0.0, -1, 0, 0.3], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
WRONG_SOURCES = {
    "no topic": (["motion", "left", "pose"], "/nothing", r"pose is not in the bag; got '/nothing'; expected one of"),
    "other type": (["motion", "left", "pose"], "/cloth", "is of another type; got sensor_msgs/msg/PointCloud2"),
    "other frame": (["motion", "left", "frame"], "table", "frame 'table' is unknown"),
    "wrench frame": (["motion", "left", "wrench_frame"], "tool", "wrench_frame is unclear"),
    "sensor's wrench": (["motion", "left", "wrench"], "/left/ft_sensor", "is in another frame; got 'sensor'; .*world"),
    "joint name": (["motion", "arm", "joints", "names"], ["j0", "elbow"], r"lacks joints; got \['elbow'\]"),
    "closed": (["motion", "arm", "closed"], "yes", "closed is not in the bag"),
    "late": (["motion", "left", "closed"], 3, "closed is unclear; got 3"),
    "misspelt": (["points", "topics"], "/cloth", "source.points.topics is unknown"),
    "rectified": (["cameras", "cam0", "rectified"], "no", "rectified is unclear"),
    "epoch": (["epoch"], 1.5, "epoch is no time"),
}


@pytest.mark.parametrize("case", WRONG_SOURCES)
def test_a_wrong_mapping_of_topics(copy, case):
    keys, value, match = WRONG_SOURCES[case]
    truth = copy("ros2")
    node = truth.scene["source"]
    for key in keys[:-1]:
        node = node[key]
    node[keys[-1]] = value
    refuse(truth, match)


def test_without_a_mapping_the_topics_are_listed(copy):
    truth = copy("ros2")
    del truth.scene["source"]
    refuse(truth, r"no topic is mapped; got the topics /closed \(Bool\), /cloth \(PointCloud2\)")


def test_a_depth_behind_the_lens_is_refused():
    body = SimpleNamespace(encoding="32FC1", is_bigendian=0, height=1, width=2, step=8)
    body.data = np.array([1.0, -0.5], np.float32).view(np.uint8)
    with pytest.raises(RecordingError, match=r"out of range; got -0\.5 m; expected depth >= 0"):
        BagImages(None, "/depth", "depth")._pixels(BagMessage("/depth", 0, body, "take: /depth"))


@pytest.mark.parametrize("what", ["pose", "wrench", "points"])
def test_what_is_in_the_world_is_not_placed_there_again(copy, what):
    """A mapping that names another frame contradicts the message: it would be moved twice."""
    truth = copy("ros2")
    source = truth.scene["source"]
    if what == "points":
        source["points"] = {"topic": "/cloth", "frame": "cam0"}
    else:
        truth.scene["robots"]["arm"]["T_world_base"] = BASE.tolist()
        pose = "/left/pose" if what == "pose" else "/left/pose_in_base"
        source["motion"]["left"] |= {"frame": "arm", "pose": pose}
    refuse(truth, "is in the world already; got 'world'; expected another frame; .*leave out frame")


@pytest.mark.parametrize("topic", ["/left/ft_sensor"])
def test_a_wrench_turns_with_the_frame_that_places_it(copy, topic):
    """Given in the axes of a robot's base, as its gripper's pose is."""
    truth = copy("ros2")
    truth.scene["robots"]["arm"]["T_world_base"] = BASE.tolist()
    truth.scene["source"]["motion"]["left"] |= {"frame": "arm", "wrench": topic, "pose": "/left/pose_in_base"}
    left = formats.read(truth.path, scene=truth.write_scene()).grippers["left"]
    np.testing.assert_allclose(left.force, truth.arrays["left/force"] @ BASE[:3, :3].T, atol=1e-15)
    np.testing.assert_allclose(left.torque, truth.arrays["left/torque"] @ BASE[:3, :3].T, atol=1e-15)


@pytest.mark.parametrize("topic", ["/left/ft", "/left/ft_sensor"])
def test_frames_are_placed_in_the_world(copy, topic):
    """A pose given in the frame of a robot's base, a wrench given in the gripper's, whatever its own is called."""
    truth = copy("ros2")
    truth.scene["robots"]["arm"]["T_world_base"] = BASE.tolist()
    truth.scene["source"]["motion"]["left"] |= {"frame": "arm", "wrench": topic, "pose": "/left/pose_in_base"}
    truth.scene["source"]["motion"]["left"]["wrench_frame"] = "gripper"
    left = formats.read(truth.path, scene=truth.write_scene()).grippers["left"]
    there = truth.arrays["left/position"]
    np.testing.assert_allclose(left.position, there @ BASE[:3, :3].T + BASE[:3, 3], atol=1e-15)
    from scipy.spatial.transform import Rotation

    local = Rotation.from_quat(truth.arrays["left/quat_wxyz"], scalar_first=True)
    world = Rotation.from_matrix(BASE[:3, :3]) * local
    assert (world * Rotation.from_quat(left.quat_wxyz, scalar_first=True).inv()).magnitude().max() < 1e-14
    np.testing.assert_allclose(left.force, world.apply(truth.arrays["left/force"]), atol=1e-14)


def test_lerobot_episodes(copy):
    truth = copy("lerobot")
    refuse(truth, "holds 2 episodes; got no --episode; expected one of 0 to 1", episode=None)
    refuse(truth, "holds 2 episodes; got --episode 2", episode=2)
    first = formats.read(truth.path, scene=truth.write_scene(), episode=0)
    assert len(first.joints["left"].t) == len(first.cameras["cam0"].color) == 6
    assert abs(int(first.cameras["cam0"].color.load(0).mean()) - foreign_formats.lerobot_truth.grey_level(0, 0)) <= 2


def test_lerobot_units_are_asked_for(copy):
    truth = copy("lerobot")
    left = truth.scene["source"]["motion"]["left"]
    left["unit"] = "turns"
    refuse(truth, "unit is unknown; got 'turns'; expected rad or deg")
    left["unit"] = "deg"
    degrees = formats.read(truth.path, scene=truth.write_scene(), **truth.options).joints["left"].q
    np.testing.assert_allclose(degrees, np.radians(truth.arrays["left/q"]), rtol=1e-15)
    left["joints"] = ["joint_9.pos"]
    refuse(truth, "joints is unknown; got 'joint_9.pos'; expected one of joint_1.pos")


def test_lerobot_values_are_held_against_their_statistics(copy):
    """A parquet file that pyarrow itself wrote, sound in every byte, with one number that was not recorded."""
    import pyarrow
    from pyarrow import parquet

    truth = copy("lerobot")
    file = truth.path / "data" / "chunk-000" / "file-000.parquet"
    table = parquet.read_table(file)
    rows = table.column("observation.state").to_pylist()
    rows[8][2] += 1e-3
    column = pyarrow.array(rows, type=table.schema.field("observation.state").type)
    parquet.write_table(table.set_column(0, "observation.state", column), file)
    refuse(truth, "observation.state contradicts its statistics; got a mean of .* in entry 2")


def test_lerobot_means_of_what_stands_still_are_as_wrong_as_float32_makes_them():
    """100 s of a joint at rest: every row of the sum is rounded alike."""
    values = np.full((3000, 2), [1.23, 0.1], np.float32)
    values[:, 1] += np.linspace(0, 1, 3000, dtype=np.float32)
    remaining = {f"stats/state/{name}": getattr(values, name)(axis=0).astype(float) for name in ("min", "max", "mean")}
    off = np.abs(remaining["stats/state/mean"] - values.astype(float).mean(axis=0)).max()
    assert off > lerobot.STATISTICS_TOLERANCE * np.abs(values).max()
    lerobot._check_statistics(values.astype(float), {"file": "meta", **remaining}, "state")
    changed = values.astype(float)
    changed[1000, 0] += 3.0
    with pytest.raises(RecordingError, match="contradicts its statistics"):
        lerobot._check_statistics(changed, {"file": "meta", **remaining}, "state")


def test_another_lerobot_version(copy):
    truth = copy("lerobot")
    file = truth.path / "meta" / "info.json"
    file.write_text(file.read_text().replace('"v3.0"', '"v2.1"'))
    refuse(truth, "another version; got 'v2.1'; expected 'v3")


def test_kinect_calibration(copy):
    """K by hand from the factory's numbers; a point seen by both lenses is at one place of the world."""
    truth = copy("kinect")
    recording = formats.read(truth.path, scene=truth.write_scene())
    depth, color = recording.cameras["depth"], recording.cameras["color"]
    factory = foreign_formats.FACTORY_LENS_PARAMETERS
    assert depth.K[0, 0] == pytest.approx(factory[2] * 512)
    assert depth.K[0, 2] == pytest.approx(factory[0] * 512 - 96 - 0.5)
    assert depth.K[1, 2] == pytest.approx(factory[1] * 512 - 90 - 0.5)
    k1, k2, k3, k4, k5, k6 = factory[4:10]
    np.testing.assert_allclose(depth.distortion, [k1, k2, factory[13], factory[12], k3, k4, k5, k6])
    assert depth.depth_scale == 0.001
    assert color.K[1, 2] == pytest.approx(0.5 * 960 - 120 - 0.5)
    in_depth = np.array([0.1, 0.2, 1.5, 1.0])
    c, s = np.cos(foreign_formats.DEPTH_CAMERA_TILT_RAD), np.sin(foreign_formats.DEPTH_CAMERA_TILT_RAD)
    in_color = np.array([[1, 0, 0, -0.032], [0, c, -s, -0.002], [0, s, c, 0.004], [0, 0, 0, 1]]) @ in_depth
    np.testing.assert_allclose(depth.T_world_camera @ in_depth, color.T_world_camera @ in_color, atol=1e-12)


def test_two_lenses_are_two_cameras(copy):
    truth = copy("kinect")
    truth.scene["source"] = {"depth": "top", "color": "top"}
    refuse(truth, "gives both lenses one name; got top")
    truth.scene["source"] = {"depth": "top", "color": "top_color"}
    truth.scene["cameras"] = {"top": {"T_world_camera": foreign_formats.CAMERA_POSE}}
    assert formats.read(truth.path, scene=truth.write_scene()).cameras.keys() == {"top", "top_color"}


def test_a_matroska_file_of_another_camera(tmp_path):
    import av

    path = tmp_path / "take.mkv"
    with av.open(str(path), "w", format="matroska") as container:
        stream = container.add_stream("ffv1", rate=30)
        stream.width, stream.height, stream.pix_fmt = 16, 12, "gray"
        container.mux(stream.encode(av.VideoFrame.from_ndarray(np.zeros((12, 16), np.uint8), format="gray")))
        container.mux(stream.encode())
    with pytest.raises(RecordingError, match="a track has an unknown title; got None; expected DEPTH, COLOR, IR, IMU"):
        formats.read(path)


@pytest.mark.parametrize(("name", "files"), [("tum", ["rgb.txt", "groundtruth.txt"]), ("redwood", ["trajectory.log"])])
def test_files_with_a_byte_order_mark_are_read(copy, name, files):
    truth = copy(name)
    for path in [truth.path / file for file in files]:
        lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
        path.write_text("\n".join(lines), encoding="utf-8-sig")
    scene = truth.write_scene()
    scene.write_text(scene.read_text(), encoding="utf-8-sig")
    assert formats.read(truth.path, scene=scene).cameras["cam0"].depth is not None


def rewrite_timestamps(truth: foreign_formats.ForeignRecording, offsets: np.ndarray) -> np.ndarray:
    """Add offsets [8] s to the times of episode 1, with its statistics; returns the times."""
    import pyarrow
    from pyarrow import parquet

    data, meta = (truth.path / name / "chunk-000" / "file-000.parquet" for name in ("data", "meta/episodes"))
    table = parquet.read_table(data)
    t = np.array(table.column("timestamp").to_pylist(), np.float32)
    t[6:] += offsets.astype(np.float32)
    column = table.column_names.index("timestamp")
    parquet.write_table(table.set_column(column, "timestamp", pyarrow.array(t)), data)
    table = parquet.read_table(meta)
    for name in ("min", "max", "mean"):
        key = f"stats/timestamp/{name}"
        rows = table.column(key).to_pylist()
        rows[1] = [float(getattr(t[6:].astype(float), name)())]
        values = pyarrow.array(rows, type=table.schema.field(key).type)
        table = table.set_column(table.column_names.index(key), key, values)
    parquet.write_table(table, meta)
    return t[6:].astype(float)


def test_lerobot_times_of_the_hardware_are_read(copy):
    """A jitter of 3 ms: the regular clock would be wrong by as much."""
    truth = copy("lerobot")
    t = rewrite_timestamps(truth, np.array([0, 3, -3, 2, -1, 3, -2, 1]) * 1e-3)
    recording = formats.read(truth.path, scene=truth.write_scene(), **truth.options)
    np.testing.assert_array_equal(recording.joints["left"].t, t)
    color = recording.cameras["cam0"].color
    np.testing.assert_array_equal(color.t, t)
    assert abs(int(color.load(7).mean()) - foreign_formats.lerobot_truth.grey_level(1, 7)) <= 2
    note = "times are those of the column timestamp, not of the clock of 10 Hz"
    assert recording.extra["source"]["repairs"] == [note]


@pytest.mark.parametrize("offsets", [[0, 0, 0, 0.03, 0, 0, 0, 0], [0, 0.2, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1]])
def test_lerobot_times_of_damage_are_refused(copy, offsets):
    truth = copy("lerobot")
    rewrite_timestamps(truth, np.array(offsets))
    refuse(truth, "timestamp is not regular|timestamp does not increase")


@pytest.mark.parametrize(
    ("K", "match"),
    [
        ([[0.8, 0, 0.5], [0, 1.07, 0.5], [0, 0, 1]], "cameras.cam0.K looks normalised; .*first row by the width"),
        ([[28.0, 0, 15.5], [0, 30, 11.5], [0, 0, 1]], r"looks like that of images 1\.93 times as large"),
        ([[7.5, 0, 14], [0, 5.25, 15], [0, 0, 1]], "cameras.cam0.K has fx, fy and cx, cy exchanged"),
    ],
)
def test_a_camera_matrix_of_other_images(copy, K, match):
    truth = copy("tum")
    for name in ("depth", "rgb"):
        for file in (truth.path / name).iterdir():
            with Image.open(file) as image:
                image.resize((32, 24)).save(file)
    K = np.array(K) * [[2, 2, 2], [2, 2, 2], [1, 1, 1]] if K[0][0] > 4 else K
    truth.scene["cameras"]["cam0"]["K"] = np.array(K).tolist()
    refuse(truth, match)


def test_times_in_milliseconds_since_1970(copy):
    truth = copy("tum")
    for file in ("rgb.txt", "depth.txt", "groundtruth.txt"):
        path = truth.path / file
        path.write_text(re.sub(r"^1305031102\.(\d{3})", r"1305031102\1.", path.read_text(), flags=re.MULTILINE))
    refuse(truth, r"looks like milliseconds; got 1305031102187; expected seconds; divide the stamps by 1000")


def test_a_urdf_beside_the_scene_goes_into_the_episode(copy, tmp_path):
    truth = copy("ros2")
    (tmp_path / "my.urdf").write_text('<robot name="mine"><link name="flange"/></robot>')
    truth.scene["robots"]["arm"]["model"] = "my.urdf"
    recording = formats.read(truth.path, scene=truth.write_scene())
    assert recording.robots["arm"].model == str((tmp_path / "my.urdf").resolve())
    episode = rec.write(recording, tmp_path / "ep")
    assert rec.read(episode).robots["arm"].model == "robots/arm/my.urdf"
    assert (episode / "robots" / "arm" / "my.urdf").is_file()


@pytest.mark.parametrize(
    ("name", "part", "match"),
    [
        ("tum", "rgb.txt", "a TUM RGB-D folder needs rgb.txt beside depth.txt; or build the episode in Python"),
        (
            "redwood",
            "camera_intrinsic.json",
            "needs camera_intrinsic.json or intrinsic.json or camera.json beside depth",
        ),
    ],
)
def test_a_folder_that_lacks_a_part_says_which(copy, name, part, match):
    truth = copy(name)
    path = truth.path / part
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    refuse(truth, f"of no known format; .*{match}")


@pytest.mark.parametrize(("name", "parts"), [("tum", ["rgb.txt", "rgb"]), ("redwood", ["color"])])
def test_a_folder_without_colour_is_read(copy, name, parts):
    truth = copy(name)
    whole = formats.read(truth.path, scene=truth.write_scene()).cameras["cam0"]
    for path in [truth.path / part for part in parts]:
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    camera = formats.read(truth.path, scene=truth.write_scene()).cameras["cam0"]
    assert camera.color is None
    np.testing.assert_allclose(camera.depth.t, whole.depth.t - whole.depth.t[0], atol=1e-9)
    np.testing.assert_array_equal(camera.T_world_camera, whole.T_world_camera)
    for i, expected in enumerate(truth.images["cam0/depth"]):
        np.testing.assert_array_equal(camera.depth.load(i), expected)


def test_a_folder_of_point_clouds_says_what_to_do(tmp_path):
    (tmp_path / "0000.ply").write_text("ply\nformat ascii 1.0")
    for path, what in ((tmp_path, "a folder with 0000.ply"), (tmp_path / "0000.ply", r"a point cloud or mesh \(PLY\)")):
        with pytest.raises(RecordingError, match=f"got {what}; .*build PointClouds in Python"):
            formats.read(path)
