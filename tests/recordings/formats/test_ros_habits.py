"""What recorders of ROS leave behind is read as it was meant, with a note on what was changed."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers import foreign_formats

from torchcloth import recordings as rec
from torchcloth.errors import RecordingError
from torchcloth.recordings import formats

FIRST_NS, STEP_NS = 1_700_000_000_000_000_000, 10_000_000
JOINTS, FINGER = ["j1", "j2"], "finger"
JOINT_SOURCE = {"motion": {"arm": {"joints": {"topic": "/joint_states", "names": JOINTS, "width": FINGER}}}}
POSE_SOURCE = {"motion": {"left": {"pose": "/pose", "closed": True}}}


class Messages:
    """Messages of standard types, by the type store of ROS 2 or, with ``ros1``, of ROS 1."""

    def __init__(self, ros1: bool = False) -> None:
        from rosbags.typesys import Stores, get_typestore

        self.ros1 = ros1
        self.store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)

    def make(self, kind: str, *values):
        return self.store.types[kind](*values)

    def header(self, ns: int, frame: str = "world"):
        stamp = self.make("builtin_interfaces/msg/Time", *divmod(ns, 10**9))
        return self.make("std_msgs/msg/Header", *([0] if self.ros1 else []), stamp, frame)

    def pose(self, ns: int, x: float):
        point = self.make("geometry_msgs/msg/Point", x, 0.0, 0.5)
        pose = self.make("geometry_msgs/msg/Pose", point, self.make("geometry_msgs/msg/Quaternion", 0, 0, 0, 1))
        return self.make("geometry_msgs/msg/PoseStamped", self.header(ns), pose)

    def joints(self, ns: int, **values: float):
        none = np.zeros(0)
        kind = "sensor_msgs/msg/JointState"
        return self.make(kind, self.header(ns), list(values), np.array(list(values.values())), none, none)

    def cloud(self, ns: int, xyz: np.ndarray, frame: str = "world"):
        kind, data = "sensor_msgs/msg/PointCloud2", np.asarray(xyz, np.float32)
        fields = [self.make("sensor_msgs/msg/PointField", name, 4 * i, 7, 1) for i, name in enumerate("xyz")]
        size, raw = len(data), data.reshape(-1).view(np.uint8)
        return self.make(kind, self.header(ns, frame), 1, size, fields, False, 12, 12 * size, raw, True)

    def image(self, ns: int, pixels: np.ndarray):
        raw, step = pixels.reshape(-1).view(np.uint8), pixels.strides[0]
        return self.make("sensor_msgs/msg/Image", self.header(ns, "lens"), *pixels.shape, "16UC1", 0, step, raw)

    def info(self, ns: int):
        K = np.array(foreign_formats.INTRINSICS_PX)
        P, region = np.column_stack([K, np.zeros(3)]), self.make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
        values = ["plumb_bob", np.zeros(5), K.reshape(-1), np.eye(3).reshape(-1), P.reshape(-1), 0, 0, region]
        return self.make("sensor_msgs/msg/CameraInfo", self.header(ns, "lens"), 12, 16, *values)

    def write(self, path: Path, topics: dict[str, list]) -> Path:
        """Write a bag; messages are logged in the order of the lists, whatever their stamps."""
        from rosbags import rosbag1, rosbag2

        plugin = rosbag2.StoragePlugin.MCAP
        with rosbag1.Writer(path) if self.ros1 else rosbag2.Writer(path, version=9, storage_plugin=plugin) as bag:
            for topic, messages in topics.items():
                kind = messages[0].__msgtype__
                connection = bag.add_connection(topic, kind, typestore=self.store)
                encode = self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr
                for i, message in enumerate(messages):
                    bag.write(connection, FIRST_NS + i * STEP_NS + 1_500_000, encode(message, kind))
        return path


def read(path: Path, source: dict, **scene) -> rec.Recording:
    truth = foreign_formats.ForeignRecording(path, {**foreign_formats.SCENE_DESCRIPTION, **scene, "source": source})
    return formats.read(path, scene=truth.write_scene())


def times(*numbers: int) -> list[int]:
    return [FIRST_NS + i * STEP_NS for i in numbers]


def notes(recording: rec.Recording) -> list[str]:
    return recording.extra["source"]["repairs"]


def test_a_message_that_was_recorded_twice_counts_once(tmp_path):
    ros = Messages()
    poses = [ros.pose(ns, 0.1 * i) for i, ns in zip((0, 1, 1, 2), times(0, 1, 1, 2), strict=True)]
    recording = read(ros.write(tmp_path / "bag", {"/pose": poses}), POSE_SOURCE)
    np.testing.assert_allclose(recording.grippers["left"].position[:, 0], [0, 0.1, 0.2])
    assert notes(recording) == ["/pose: 1 of 4 messages were there twice, one is used"]


def test_two_poses_at_one_time_are_refused(tmp_path):
    ros = Messages()
    path = ros.write(tmp_path / "bag", {"/pose": [ros.pose(ns, 0.1 * i) for i, ns in enumerate(times(0, 1, 1))]})
    with pytest.raises(RecordingError, match="does not increase"):
        read(path, POSE_SOURCE)


def test_messages_out_of_order_are_sorted_by_their_stamps(tmp_path):
    ros = Messages()
    path = ros.write(tmp_path / "bag", {"/pose": [ros.pose(ns, 1e-7 * (ns - FIRST_NS)) for ns in times(0, 2, 1, 3)]})
    recording = read(path, POSE_SOURCE)
    left = recording.grippers["left"]
    np.testing.assert_allclose(left.t, [0, 0.01, 0.02, 0.03])
    np.testing.assert_allclose(left.position[:, 0], [0, 1, 2, 3])
    assert notes(recording) == ["/pose: 1 of 4 messages were out of order, sorted by header.stamp"]


def test_images_and_clouds_out_of_order_and_twice(tmp_path):
    ros, order = Messages(), (0, 2, 2, 1, 3)
    images = [ros.image(ns, np.full((12, 16), 1000 + k, np.uint16)) for k, ns in zip(order, times(*order), strict=True)]
    clouds = [ros.cloud(ns, np.full((3, 3), 0.1 * k + 0.1)) for k, ns in zip(order, times(*order), strict=True)]
    path = ros.write(tmp_path / "bag", {"/depth": images, "/info": [ros.info(FIRST_NS)], "/cloth": clouds})
    source = {"cameras": {"cam0": {"depth": "/depth", "info": "/info"}}, "points": {"topic": "/cloth"}}
    recording = read(path, source, cameras={"cam0": {"T_world_camera": foreign_formats.CAMERA_POSE}})
    depth, points = recording.cameras["cam0"].depth, recording.points
    np.testing.assert_allclose(depth.t, [0, 0.01, 0.02, 0.03])
    assert [int(depth.load(i).max()) for i in range(4)] == [1000, 1001, 1002, 1003]
    np.testing.assert_allclose(points.t, depth.t)
    np.testing.assert_allclose([points.frame(i)[0, 0] for i in range(4)], [0.1, 0.2, 0.3, 0.4], atol=1e-7)
    assert len(notes(recording)) == 4


def test_a_finger_in_messages_of_its_own(tmp_path):
    """An arm's driver and a gripper's driver share /joint_states; the finger is slower."""
    ros = Messages()
    messages = [ros.joints(ns, j1=0.1 * i, j2=0.0) for i, ns in enumerate(times(0, 1, 2, 3, 4))]
    messages += [ros.joints(ns + 1_000_000, finger=0.04 - 0.01 * i) for i, ns in enumerate(times(0, 2, 4))]
    arm = read(ros.write(tmp_path / "bag", {"/joint_states": messages}), JOINT_SOURCE).joints["arm"]
    np.testing.assert_allclose(arm.q[:, 0], [0, 0.1, 0.2, 0.3, 0.4])
    np.testing.assert_allclose(arm.width, [0.04, 0.0355, 0.0305, 0.0255, 0.0205])


def test_a_finger_that_is_never_named(tmp_path):
    ros = Messages()
    path = ros.write(tmp_path / "bag", {"/joint_states": [ros.joints(ns, j1=0.0, j2=0.0) for ns in times(0, 1)]})
    with pytest.raises(RecordingError, match=r"no message of /joint_states holds the joints; got \['finger'\]"):
        read(path, JOINT_SOURCE)


def test_points_at_the_lens_are_no_readings(tmp_path):
    """Drivers of stereo cameras write (0, 0, 0) where others write NaN."""
    ros = Messages()
    cloud = ros.cloud(FIRST_NS, [[0, 0, 0], [0.1, 0.2, 1.0], [0, 0, 0], [np.nan, 0, 0], [0, 0, 1.0]], "lens")
    path = ros.write(tmp_path / "bag", {"/cloth": [cloud]})
    lens = {"width": 16, "height": 12, "K": foreign_formats.INTRINSICS_PX}
    cameras = {"cam0": {"T_world_camera": foreign_formats.CAMERA_POSE, **lens}}
    recording = read(path, {"points": {"topic": "/cloth", "frame": "cam0"}}, cameras=cameras)
    np.testing.assert_allclose(recording.points.xyz, [[0.7, 0.2, 0.5], [0.5, 0.1, 0.5]], atol=1e-6)


def test_a_point_at_the_origin_survives_our_own_mcap(recording, tmp_path):
    recording.points.xyz[3] = 0.0
    back = formats.read(formats.write_mcap(recording, tmp_path / "ep.mcap"))
    np.testing.assert_array_equal(back.points.counts, recording.points.counts)


def test_a_bag_folder_without_its_metadata(tmp_path):
    """As a killed recorder leaves it: its one storage file is read, of several the order is not known."""
    truth = foreign_formats.write_ros2(tmp_path)
    (truth.path / "metadata.yaml").unlink()
    assert formats.detect_format(truth.path) == "ros2"
    recording = formats.read(truth.path, scene=truth.write_scene())
    np.testing.assert_array_equal(recording.joints["arm"].q, truth.arrays["arm/q"])
    assert any("metadata.yaml is missing" in note for note in notes(recording))
    file = next(truth.path.glob("*.mcap"))
    shutil.copy(file, file.with_name("second.mcap"))
    with pytest.raises(RecordingError, match=r"metadata.yaml is missing; got 2 storage files; .*ros2 bag reindex"):
        formats.read(truth.path, scene=truth.write_scene())


def test_a_ros1_bag(tmp_path):
    ros = Messages(ros1=True)
    topics = {
        "/pose": [ros.pose(ns, 0.1 * i) for i, ns in enumerate(times(0, 1, 2))],
        "/depth": [ros.image(ns, np.full((12, 16), 1000 + i, np.uint16)) for i, ns in enumerate(times(0, 1, 2))],
        "/info": [ros.info(FIRST_NS)],
        "/cloth": [ros.cloud(ns, np.full((3, 3), 0.1)) for ns in times(0, 1)],
    }
    source = {
        **POSE_SOURCE,
        "cameras": {"cam0": {"depth": "/depth", "info": "/info"}},
        "points": {"topic": "/cloth"},
    }
    path = ros.write(tmp_path / "take.bag", topics)
    recording = read(path, source, cameras={"cam0": {"T_world_camera": foreign_formats.CAMERA_POSE}})
    np.testing.assert_allclose(recording.grippers["left"].position[:, 0], [0, 0.1, 0.2])
    camera = recording.cameras["cam0"]
    np.testing.assert_array_equal(camera.K, foreign_formats.INTRINSICS_PX)
    assert [int(camera.depth.load(i).max()) for i in range(3)] == [1000, 1001, 1002]
    assert len(recording.points) == 2


def test_a_ros1_bag_without_its_index(tmp_path):
    ros = Messages(ros1=True)
    path = ros.write(tmp_path / "take.bag", {"/pose": [ros.pose(ns, 0.0) for ns in times(0, 1)]})
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(RecordingError, match=r"no sound ROS 1 bag; .*reindex"):
        read(path, POSE_SOURCE)
