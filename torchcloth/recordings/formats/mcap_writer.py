"""Writer of MCAP files: a recording as one file of standard ROS 2 messages, with checksums over every byte.

    /NAME/pose, /NAME/closed, /NAME/joints, /NAME/wrench      PoseStamped, Bool, JointState, WrenchStamped
    /points                                                   PointCloud2, x y z in float64
    /CAMERA/info, /CAMERA/depth, /CAMERA/color, /CAMERA/mask  CameraInfo, CompressedImage (the files as they are)
    /torchcloth/scene, /torchcloth/files                      the rest, see ``embedded``

The messages are written by rosbags. Times are integer nanoseconds: those of the recording are rounded by at most half a
nanosecond.
"""

from __future__ import annotations

import io
import json
import re
import uuid
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import MissingDependency, RecordingError
from ...meshes import obj
from .. import atomic_write, images, streams, writing
from ..files import save_npz
from ..types import Camera, PointClouds, Recording
from . import embedded, mcap_checksums, ros2
from .imported import NANOSECONDS_PER_SECOND
from .ros2_topics import WORLD_FRAMES
from .scene_file import SceneFile

WriteEvent = tuple[int, Callable[[], None]]  # ns, and what writes the message of that time
FINGER_JOINT_NAME = "finger_width"
STAMP_LIMIT_NS = 2**31 * NANOSECONDS_PER_SECOND  # the first time that a stamp cannot represent


def write(
    recording: Recording,
    path: str | Path,
    *,
    overwrite: bool = False,
    on_image: Callable[[], None] = lambda: None,
) -> Path:
    """Write ``path`` atomically; ``formats.read`` gives the recording back.

    Args:
        recording: to write.
        path: the file.
        overwrite: replace an existing file.
        on_image: called after each image, for a progress bar.

    Raises:
        RecordingError: the file exists, or cannot be written.
        MissingDependency: rosbags is not installed.
    """
    target = Path(path)
    if target.exists() and (not overwrite or not target.is_file()):
        raise RecordingError(f"{target} exists", expected="a new name", remedy="pass overwrite=True to replace a file")
    part = target.absolute().with_name(f".{target.name}.{uuid.uuid4().hex}.partial")
    try:
        with atomic_write.temporary_path(part):
            _Bag(part, recording, on_image).write()
            file = part / f"{part.name}.mcap"
            mcap_checksums.write_checksums(file)
            _read_back(file, target)
            atomic_write.sync_to_disk(file)
            file.replace(target.absolute())
            atomic_write.sync_to_disk(target.absolute().parent)
    except (OSError, ValueError, TypeError) as error:
        if isinstance(error, RecordingError | MissingDependency):
            raise
        raise RecordingError(f"{target} cannot be written", got=error, remedy="nothing was changed") from error
    return target


def _read_back(file: Path, target: Path) -> None:
    """Refuse a file that cannot be read again, under its final name."""
    scene = SceneFile.read(None)
    try:
        scene.complete_recording(ros2.read(file, scene, None), target)
    except RecordingError as error:
        what = error.what.replace(str(file), str(target))
        raise RecordingError(what, got=error.got, expected=error.expected, remedy=error.remedy) from error


class _Bag:
    """A recording that is being written into a bag."""

    def __init__(self, folder: Path, recording: Recording, on_image: Callable[[], None]) -> None:
        try:
            from rosbags.rosbag2 import StoragePlugin, Writer  # pyright: ignore[reportMissingImports]  (optional)
            from rosbags.typesys import Stores, get_typestore  # pyright: ignore[reportMissingImports]
        except ImportError as error:
            message = "writing MCAP needs rosbags"
            raise MissingDependency(message, remedy='pip install "torchcloth[data]"') from error
        self.store = get_typestore(Stores.ROS2_HUMBLE)
        self.bag = Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
        self.recording, self.on_image = recording, on_image
        self.epoch = _epoch(recording)
        self.events: list[WriteEvent] = []
        self.images: list[Iterator[Any]] = []
        self.mapping: dict[str, Any] = {"epoch": self.epoch, "motion": {}, "cameras": {}}
        if (source := recording.extra.get("source")) is not None:
            self.mapping["origin"] = source  # the file that the recording was imported from

    def write(self) -> None:
        """Write every message in the order of time."""
        writing.build_motion_arrays(self.recording)  # checks that pose and joints of a name agree in shared arrays
        with self.bag:
            for name in {**self.recording.grippers, **self.recording.joints}:
                self._motion(name)
            if self.recording.points is not None:
                self._points(self.recording.points)
            for name, camera in self.recording.cameras.items():
                self._camera(name, camera)
            first = min((ns for ns, _ in self.events), default=self.epoch)
            self._rest(first)
            for _, put in sorted(self.events, key=lambda event: event[0]):  # the sort is stable for equal times
                put()
            for files in self.images:
                deque(files, 0)  # iterate to the end, where errors of a whole stream are raised

    def _topic(self, name: str, kind: str, message: Callable[[int], Any], times: Any, *, first: bool = False) -> str:
        """Add a topic with the message ``message(i)`` at each of ``times`` [ns]."""
        if any(c.topic == name for c in self.bag.connections):
            raise RecordingError(f"the topic {name} would stand for two names", remedy="rename one of them")
        connection = self.bag.add_connection(name, kind, typestore=self.store)

        def put(i: int, ns: int) -> None:
            self.bag.write(connection, ns, self.store.serialize_cdr(message(i), kind))

        events = [(ns, lambda i=i, ns=ns: put(i, ns)) for i, ns in enumerate(times)]
        self.events = [*events, *self.events] if first else [*self.events, *events]
        return name

    def _type(self, kind: str, *values: Any) -> Any:
        return self.store.types[kind](*values)

    def _header(self, ns: int, frame: str = WORLD_FRAMES[0]) -> Any:
        time = self._type("builtin_interfaces/msg/Time", *divmod(ns, NANOSECONDS_PER_SECOND))
        return self._type("std_msgs/msg/Header", time, frame)

    def _times(self, t: np.ndarray) -> list[int]:
        times = [self.epoch + round(value * NANOSECONDS_PER_SECOND) for value in t.tolist()]
        if max(times, default=0) >= STAMP_LIMIT_NS:
            got, expected = (
                f"a time of {float(t.max()):g} s",
                f"less than {(STAMP_LIMIT_NS - self.epoch) / NANOSECONDS_PER_SECOND:g} s",
            )
            raise RecordingError("stamps of ROS 2 end in 2038", got=got, expected=expected, remedy="begin at 0 s")
        return times

    def _motion(self, name: str) -> None:
        gripper, arm = self.recording.grippers.get(name), self.recording.joints.get(name)
        shared: Any = gripper or arm
        times, base = self._times(shared.t), f"/{_topic_name(name)}"
        mapping: dict[str, Any] = {}
        if gripper is not None:
            kind = "geometry_msgs/msg/PoseStamped"
            mapping["pose"] = self._topic(
                f"{base}/pose",
                kind,
                lambda i: self._type(
                    kind, self._header(times[i]), self._pose(gripper.position[i], gripper.quat_wxyz[i])
                ),
                times,
            )
        if arm is not None:
            mapping["joints"] = self._joints(f"{base}/joints", arm, times)
        if shared.closed is not None:
            kind_of = "std_msgs/msg/Bool"
            closed = shared.closed
            changes = np.flatnonzero(np.diff(closed, prepend=~closed[:1]))
            mapping["closed"] = self._topic(
                f"{base}/closed",
                kind_of,
                lambda i: self._type(kind_of, bool(closed[changes[i]])),
                [times[k] for k in changes],
                first=True,
            )
        if shared.force is not None or shared.torque is not None:
            mapping |= {"wrench": self._wrench(f"{base}/wrench", shared, times), "wrench_frame": "world"}
        self.mapping["motion"][name] = mapping

    def _pose(self, position: np.ndarray, quat: np.ndarray) -> Any:
        w, x, y, z = quat.tolist()
        point = self._type("geometry_msgs/msg/Point", *position.tolist())
        return self._type("geometry_msgs/msg/Pose", point, self._type("geometry_msgs/msg/Quaternion", x, y, z, w))

    def _joints(self, topic: str, arm: Any, times: list[int]) -> dict[str, Any]:
        names = [f"joint_{j + 1}" for j in range(arm.q.shape[1])]
        kind, none = "sensor_msgs/msg/JointState", np.zeros(0)
        values = np.ascontiguousarray(arm.q if arm.width is None else np.column_stack([arm.q, arm.width]))
        streams_by_kind = names if arm.width is None else [*names, FINGER_JOINT_NAME]
        self._topic(
            topic,
            kind,
            lambda i: self._type(kind, self._header(times[i], ""), streams_by_kind, values[i], none, none),
            times,
        )
        return {"topic": topic, "names": names, **({} if arm.width is None else {"width": FINGER_JOINT_NAME})}

    def _wrench(self, topic: str, motion: Any, times: list[int]) -> str:
        kind, vector = "geometry_msgs/msg/WrenchStamped", "geometry_msgs/msg/Vector3"
        none = np.full((len(times), 3), np.nan)  # means that it was not measured
        force = none if motion.force is None else motion.force
        torque = none if motion.torque is None else motion.torque

        def message(i: int) -> Any:
            both = [self._type(vector, *values[i].tolist()) for values in (force, torque)]
            return self._type(kind, self._header(times[i]), self._type("geometry_msgs/msg/Wrench", *both))

        return self._topic(topic, kind, message, times)

    def _points(self, points: PointClouds) -> None:
        kind, times = "sensor_msgs/msg/PointCloud2", self._times(points.t)
        starts = np.concatenate([[0], np.cumsum(points.counts)])
        columns = [self._type("sensor_msgs/msg/PointField", n, 8 * k, 8, 1) for k, n in enumerate("xyz")]

        def message(i: int) -> Any:
            xyz = np.ascontiguousarray(points.xyz[starts[i] : starts[i + 1]], dtype="<f8")
            data, n = xyz.reshape(-1).view(np.uint8), len(xyz)
            return self._type(kind, self._header(times[i]), 1, n, columns, False, 24, 24 * n, data, True)

        self.mapping["points"] = {"topic": self._topic("/points", kind, message, times)}

    def _camera(self, name: str, camera: Camera) -> None:
        streams_by_kind: dict[images.ImageKind, images.ImageStream]
        streams_by_kind = {
            kind: getattr(camera, kind) for kind in images.IMAGE_KINDS if getattr(camera, kind) is not None
        }
        if not streams_by_kind:
            return
        base = f"/{_topic_name(name)}"
        mapping: dict[str, Any] = {"frames": {kind: stream.frames.tolist() for kind, stream in streams_by_kind.items()}}
        for kind, stream in streams_by_kind.items():
            mapping[kind] = self._images(f"{base}/{kind}", stream)
        kind_of, first = "sensor_msgs/msg/CameraInfo", min(self._times(s.t)[0] for s in streams_by_kind.values())
        region = self._type("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
        P = np.column_stack([camera.K, np.zeros(3)])
        model = "plumb_bob" if len(camera.distortion) <= 5 else "rational_polynomial"
        size, K, R = (camera.height, camera.width), camera.K.reshape(-1), np.eye(3).reshape(-1)
        message = self._type(
            kind_of, self._header(first, name), *size, model, camera.distortion, K, R, P.reshape(-1), 0, 0, region
        )
        mapping["info"] = self._topic(f"{base}/info", kind_of, lambda _: message, [first], first=True)
        self.mapping["cameras"][name] = mapping | {"rectified": False}

    def _images(self, topic: str, stream: images.ImageStream) -> str:
        kind, times, files = "sensor_msgs/msg/CompressedImage", self._times(stream.t), stream.iterate_files()
        self.images.append(files)

        def message(i: int) -> Any:
            _, suffix, data = next(files)  # messages are written in the order of time, which is that of the files
            self.on_image()
            pixels = np.frombuffer(data, dtype=np.uint8)
            return self._type(kind, self._header(times[i]), "png" if suffix == ".png" else "jpeg", pixels)

        return self._topic(topic, kind, message, times)

    def _rest(self, first: int) -> None:
        """Write the scene and the small files at the beginning."""
        small = list(_files(self.recording))
        layout, dimension = "std_msgs/msg/MultiArrayLayout", "std_msgs/msg/MultiArrayDimension"
        kind = "std_msgs/msg/UInt8MultiArray"

        def file(i: int) -> Any:
            name, data = small[i]
            size = self._type(dimension, name, len(data), len(data))
            return self._type(kind, self._type(layout, [size], 0), np.frombuffer(data, dtype=np.uint8))

        if small:
            self._topic(embedded.FILES_TOPIC, kind, file, [first] * len(small), first=True)
        scene = json.dumps(
            {**writing.build_episode_json(self.recording), "source": self.mapping}, default=writing.to_json_value
        )
        text = "std_msgs/msg/String"
        self._topic(embedded.SCENE_TOPIC, text, lambda _: self._type(text, scene), [first], first=True)


def _files(recording: Recording) -> Iterator[tuple[str, bytes]]:
    """Small files by name, and the arrays for which no standard message has a place."""
    cloth = recording.cloth
    if cloth.vertices is not None and cloth.faces is not None:
        yield writing.MESH_FILE, obj.dump(cloth.vertices, cloth.faces, cloth.uv).encode()
    for name, array in writing.initial_state_files(cloth).items():
        file = io.BytesIO()
        np.save(file, array, allow_pickle=False)
        yield name, file.getvalue()
    for name, stream in ((streams.MARKERS_FILE, recording.markers), (streams.TRUTH_FILE, recording.truth)):
        if stream is not None:
            yield name, _npz(writing.bag_fields(stream))
    motions = [*recording.joints.items(), *recording.grippers.items()]
    extra = {f"motion/{name}/{key}": value for name, motion in motions for key, value in motion.extra.items()}
    if recording.points is not None:
        extra |= {f"points/{key}": value for key, value in recording.points.extra.items()}
    if extra:
        yield embedded.EXTRA_ARRAYS_FILE, _npz(extra)


def _npz(arrays: dict[str, Any]) -> bytes:
    file = io.BytesIO()
    save_npz(file, arrays)
    return file.getvalue()


def _epoch(recording: Recording) -> int:
    """Absolute time [ns] of t = 0: that of the imported file, or else such that no time is before 1 s."""
    bags = [*recording.grippers.values(), *recording.joints.values(), recording.points]
    bags += [s for c in recording.cameras.values() for s in (c.depth, c.color, c.mask)]
    earliest = min((float(bag.t[0]) for bag in bags if bag is not None), default=0.0)
    known = recording.extra.get("source")
    start = known.get("start_ns") if isinstance(known, dict) else None
    if isinstance(start, int) and start + earliest * NANOSECONDS_PER_SECOND >= NANOSECONDS_PER_SECOND:
        return start
    return NANOSECONDS_PER_SECOND * (1 - min(0, int(np.floor(earliest))))


def _topic_name(name: str) -> str:
    """A name as ROS allows it in a topic."""
    return re.sub(r"\W", "_", name, flags=re.ASCII)
