"""Topics of one gripper or arm, and of the cloth's points, in a ROS 2 bag."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...errors import RecordingError
from .. import checks
from ..checks import Fields
from . import ros2_messages
from .bag import Bag, BagMessage
from .imported import order_by_stamp, reject_unknown_keys, to_pose_matrices, to_quaternions, to_seconds
from .scene_file import SceneFile

WORLD_FRAMES = ("world", "map")
SCENE_TOPIC = "/torchcloth/scene"  # of bags by our own writer
MAX_WRENCH_DELAY_S = 0.1  # wrenches may begin this much after the first knot, or end this much before the last


def require_topic(fields: Fields, key: str, bag: Bag, *kinds: str) -> str:
    """Return the topic of the bag that the key names, which must hold one of these message types."""
    name = fields.text(key)
    if name not in bag.types:
        raise RecordingError(
            f"{fields.location(key)} is not in the bag", got=repr(name), expected=f"one of {sorted(bag.types)}"
        )
    if bag.types[name].rpartition("/")[2] not in kinds:
        raise RecordingError(
            f"{fields.location(key)} is of another type", got=bag.types[name], expected=" or ".join(kinds)
        )
    return name


def frame_pose_of(fields: Fields, scene: SceneFile) -> np.ndarray | None:
    """Return the pose of the frame that the mapping names; None if it names none."""
    frame = fields.optional(fields.text, "frame")
    return None if frame is None else scene.frame_pose(frame)


def check_world_frame(message: BagMessage, frame: np.ndarray | None, remedy: str) -> None:
    """Refuse a message in another frame than the world, unless the mapping places its frame.

    A message in the world frame is refused if the mapping places another one.
    """
    frame_id = message.body.header.frame_id
    if frame is not None and not np.array_equal(frame, np.eye(4)) and frame_id.strip("/") in WORLD_FRAMES:
        raise RecordingError(
            f"{message.place} is in the world already",
            got=repr(frame_id),
            expected="another frame",
            remedy="leave out frame, or let the driver say which frame it means",
        )
    if frame is None and frame_id.strip("/") not in WORLD_FRAMES:
        raise RecordingError(
            f"{message.place} is in another frame", got=repr(frame_id), expected="world or map", remedy=remedy
        )


class MotionTopics:
    """The topics of one gripper or arm: a pose or joint states, and what belongs to them."""

    def __init__(self, fields: Fields, bag: Bag, scene: SceneFile) -> None:
        self.place = fields.place
        self.pose = require_topic(fields, "pose", bag, "PoseStamped") if fields.has("pose") else None
        self.frame = frame_pose_of(fields, scene)
        self.joints = JointTopic(fields.group("joints"), bag) if fields.has("joints") else None
        if self.pose is None and self.joints is None:
            raise RecordingError(f"{self.place} has no motion", got=sorted(fields.remaining), expected="pose or joints")
        self.closed = ClosedTopic(fields, bag)
        self.wrench = require_topic(fields, "wrench", bag, "WrenchStamped") if fields.has("wrench") else None
        self.wrench_frame = fields.text("wrench_frame") if self.wrench else None
        if self.wrench_frame not in (None, "world", "gripper") or (self.wrench_frame == "gripper" and not self.pose):
            got, expected = self.wrench_frame, "world, or gripper where there is a pose"
            raise RecordingError(f"{fields.location('wrench_frame')} is unclear", got=got, expected=expected)
        reject_unknown_keys(fields)
        joints = self.joints.topic if self.joints else None
        self.topics = [t for t in (self.pose, joints, self.closed.topic, self.wrench) if t]
        self._poses: list[tuple[int, int, np.ndarray]] = []  # times of measurement and logging [ns], pose
        self._wrenches: list[tuple[int, np.ndarray]] = []
        self.notes: list[str] = []

    def take(self, message: BagMessage) -> None:
        """Store the content of a message."""
        body = message.body
        if message.topic == self.closed.topic:
            self.closed.take(message)
        elif message.topic == self.pose:
            check_world_frame(message, self.frame, f'set "frame" in {self.place}')
            pose = [
                ros2_messages.read_position(body.pose.position),
                ros2_messages.read_quaternion(body.pose.orientation),
            ]
            self._poses.append((ros2_messages.read_stamp(body, message.place), message.log_time, np.concatenate(pose)))
        elif message.topic == self.wrench:
            if self.wrench_frame == "world":
                remedy = f'set "frame" in {self.place}, or "wrench_frame": "gripper"'
                check_world_frame(message, self.frame, remedy)
            both = [ros2_messages.read_position(body.wrench.force), ros2_messages.read_position(body.wrench.torque)]
            self._wrenches.append((ros2_messages.read_stamp(body, message.place), np.concatenate(both)))
        elif self.joints:
            self.joints.take(message)

    def stamps(self) -> list[int]:
        """Return the times of measurement [ns]."""
        return [pose[0] for pose in self._poses] + (self.joints.stamps() if self.joints else [])

    def arrays(self, start: int) -> dict[str, np.ndarray]:
        """Return the arrays of motion.npz."""
        out: dict[str, np.ndarray] = {}
        if self.joints:
            out, logged = self.joints.arrays(start), self.joints.logged()
            self.notes += self.joints.notes
        self._poses = self._in_order(self._poses, self.pose)
        self._wrenches = self._in_order(self._wrenches, self.wrench)
        if self.pose:
            poses, logged = self._pose_arrays(start), [p[1] for p in self._poses]
            if out and not np.array_equal(poses["t"], out["t"]):
                got, expected = "different times", "the same, for they share their knots"
                raise RecordingError(f"{self.place}: pose and joints", got=got, expected=expected, remedy="map one")
            out |= poses
        closed = self.closed.at(logged, self.place)
        if closed is not None:
            out["closed"] = closed
        if self.wrench and not self._wrenches:
            raise RecordingError(
                f"{self.place}: {self.wrench} is empty", expected="wrenches", remedy="leave it out of source"
            )
        return out | self._wrench_arrays(out, start) if self._wrenches else out

    def _in_order(self, messages: list[Any], topic: str | None) -> list[Any]:
        """Messages (stamp, ..., array) by their stamps, each once."""
        stamps, contents = [message[0] for message in messages], [message[-1].tobytes() for message in messages]
        chosen, notes = order_by_stamp(stamps, contents, f"{topic}")
        self.notes += notes
        return [messages[i] for i in chosen]

    def _pose_arrays(self, start: int) -> dict[str, np.ndarray]:
        if not self._poses:
            raise RecordingError(f"{self.place}: {self.pose} is empty", expected="poses")
        values = np.array([p[2] for p in self._poses])
        position, quat = values[:, :3], values[:, 3:]
        if self.frame is not None and not np.array_equal(self.frame, np.eye(4)):
            turned = self.frame @ to_pose_matrices(position, quat, self.place)
            position, quat = turned[:, :3, 3], to_quaternions(turned[:, :3, :3])
        return {"t": to_seconds([p[0] for p in self._poses], start), "position": position, "quat_wxyz": quat}

    def _wrench_arrays(self, out: dict[str, np.ndarray], start: int) -> dict[str, np.ndarray]:
        """Force and torque at the knots; a half that is NaN throughout was not measured."""
        known = to_seconds([s for s, _ in self._wrenches], start)
        halves = {"force": slice(0, 3), "torque": slice(3, 6)}
        values = np.array([w for _, w in self._wrenches])
        arrays = {}
        for key, half in halves.items():
            if np.isnan(values[:, half]).all():
                continue
            at_knots = interpolate_linearly(out["t"], known, values[:, half], f"{self.place}: {self.wrench}")
            if self.wrench_frame == "gripper":
                turns = to_pose_matrices(out["position"], out["quat_wxyz"], self.place)[:, :3, :3]
                at_knots = np.einsum("kij,kj->ki", turns, at_knots)
            elif self.frame is not None:  # like the poses; the torque is about the gripper in every frame
                at_knots = at_knots @ self.frame[:3, :3].T
            arrays[key] = at_knots
        return arrays


class JointTopic:
    """The joint states of one arm; messages without any of its joints belong to another arm.

    The finger may come in messages of its own: its opening is then interpolated to the times of the arm.
    """

    def __init__(self, fields: Fields, bag: Bag) -> None:
        self.place = fields.place
        self.topic = require_topic(fields, "topic", bag, "JointState")
        names = fields.take("names")
        if not isinstance(names, list) or not names or not all(isinstance(n, str) for n in names):
            raise RecordingError(f"{fields.location('names')} is unclear", got=names, expected="joint names, in order")
        self.names, self.width = names, fields.optional(fields.text, "width")
        reject_unknown_keys(fields)
        self.notes: list[str] = []
        self._states: list[tuple[int, int, np.ndarray]] = []  # times of measurement and logging [ns], angles
        self._widths: list[tuple[int, np.ndarray]] = []

    def take(self, message: BagMessage) -> None:
        """Store the content of a message."""
        body = message.body
        values = dict(zip(body.name, np.asarray(body.position, dtype=float).tolist(), strict=False))
        missing = [n for n in self.names if n not in values]
        has_width = self.width is not None and self.width in values
        if len(missing) == len(self.names) and not has_width:
            return
        if (missing and len(missing) < len(self.names)) or len(values) < len(body.name):
            raise RecordingError(f"{message.place} lacks joints", got=missing or "fewer positions than names")
        stamp = ros2_messages.read_stamp(body, message.place)
        if not missing:
            self._states.append((stamp, message.log_time, np.array([values[n] for n in self.names])))
        if has_width:
            self._widths.append((stamp, np.array([values[self.width or ""]])))

    def stamps(self) -> list[int]:
        """Return the times of measurement [ns]."""
        return [state[0] for state in self._states]

    def logged(self) -> list[int]:
        """Return the times of logging [ns]."""
        return [state[1] for state in self._states]

    def arrays(self, start: int) -> dict[str, np.ndarray]:
        """Return t, q and width as in motion.npz."""
        if not self._states or (self.width and not self._widths):
            names = self.names if not self._states else [self.width]
            raise RecordingError(f"{self.place}: no message of {self.topic} holds the joints", got=names)
        chosen, self.notes = order_by_stamp(
            self.stamps(), [state[2].tobytes() for state in self._states], f"{self.topic}, {self.names[0]} ..."
        )
        self._states = [self._states[i] for i in chosen]
        t, q = to_seconds(self.stamps(), start), np.array([state[2] for state in self._states])
        return {"t": t, "q": q, "width": self._width_at(t, start)} if self.width else {"t": t, "q": q}

    def _width_at(self, t: np.ndarray, start: int) -> np.ndarray:
        """Opening [K] m at the times of the arm."""
        stamps, contents = [w[0] for w in self._widths], [w[1].tobytes() for w in self._widths]
        chosen, notes = order_by_stamp(stamps, contents, f"{self.topic}, {self.width}")
        known = to_seconds([stamps[i] for i in chosen], start)
        values = np.array([self._widths[i][1] for i in chosen])
        if np.array_equal(known, t):
            return values[:, 0]
        self.notes += [*notes, f"{self.topic}: {self.width} comes in messages of its own and is interpolated"]
        return interpolate_linearly(t, known, values, f"{self.place}: {self.width}")[:, 0]


class ClosedTopic:
    """When a gripper holds: a constant, or a topic of std_msgs/Bool whose value lasts until its next message."""

    def __init__(self, fields: Fields, bag: Bag) -> None:
        value = fields.remaining.get("closed")
        self.constant = value if isinstance(value, bool) else None
        self.topic = require_topic(fields, "closed", bag, "Bool") if isinstance(value, str) else None
        if value is not None and self.topic is None and self.constant is None:
            raise RecordingError(
                f"{fields.location('closed')} is unclear", got=value, expected="a topic, true or false"
            )
        fields.remaining.pop("closed", None)
        self._events: list[tuple[int, bool]] = []

    def take(self, message: BagMessage) -> None:
        """Store one change of the gripper's state."""
        self._events.append((message.log_time, bool(message.body.data)))

    def at(self, logged: list[int], place: str) -> np.ndarray | None:
        """Return whether the gripper holds at these times of logging [K] ns."""
        if self.topic is None:
            return None if self.constant is None else np.full(len(logged), self.constant)
        times = np.array([t for t, _ in self._events], dtype=np.int64)
        index = np.searchsorted(times, np.asarray(logged, dtype=np.int64), side="right") - 1
        if not len(times) or index.min() < 0:
            remedy = 'or write "closed": true'
            raise RecordingError(f"{place}: {self.topic} begins late", expected="before the motion", remedy=remedy)
        return np.array([value for _, value in self._events])[index]


class CloudTopic:
    """Reader of a topic with segmented cloth points."""

    def __init__(self, fields: Fields, bag: Bag, scene: SceneFile) -> None:
        self.place = fields.place
        self.topic = require_topic(fields, "topic", bag, "PointCloud2")
        self.frame = frame_pose_of(fields, scene)
        reject_unknown_keys(fields)
        self.topics = [self.topic]
        self.is_from_driver = SCENE_TOPIC not in bag.types  # else our own writer's, whose points are all readings
        self.notes: list[str] = []
        self._clouds: list[tuple[int, np.ndarray]] = []

    def take(self, message: BagMessage) -> None:
        """Store a cloud; an empty one is left out."""
        check_world_frame(message, self.frame, f'set "frame" in {self.place}')
        xyz = ros2_messages.read_cloud(message.body, message.place)
        if self.is_from_driver:
            xyz = xyz[xyz.any(axis=1)]  # drivers write (0, 0, 0), the lens, where there is no reading
        if len(xyz):
            self._clouds.append((ros2_messages.read_stamp(message.body, message.place), xyz))

    def stamps(self) -> list[int]:
        """Return the times of measurement [ns]."""
        return [cloud[0] for cloud in self._clouds]

    def arrays(self, start: int) -> dict[str, np.ndarray]:
        """Return the arrays of points.npz."""
        if not self._clouds:
            raise RecordingError(f"{self.place}: {self.topic} holds no point", expected="clouds of the cloth")
        chosen, self.notes = order_by_stamp(self.stamps(), [xyz.tobytes() for _, xyz in self._clouds], self.topic)
        self._clouds = [self._clouds[i] for i in chosen]
        xyz = np.concatenate([cloud for _, cloud in self._clouds])
        if self.frame is not None and not np.array_equal(self.frame, np.eye(4)):
            xyz = xyz @ self.frame[:3, :3].T + self.frame[:3, 3]
        counts = np.array([len(cloud) for _, cloud in self._clouds])
        return {"t": to_seconds(self.stamps(), start), "xyz": xyz, "counts": counts}


def interpolate_linearly(t: np.ndarray, known: np.ndarray, values: np.ndarray, place: str) -> np.ndarray:
    """Return values [K, D] at ``t`` by linear interpolation.

    Raises:
        RecordingError: the known times do not increase or do not cover ``t``.
    """
    checks.check_increasing(known, f"{place}: its times")
    if t[0] < known[0] - MAX_WRENCH_DELAY_S or t[-1] > known[-1] + MAX_WRENCH_DELAY_S:
        got, expected = f"{known[0]:.6g} to {known[-1]:.6g} s", f"{t[0]:.6g} to {t[-1]:.6g} s, as the motion"
        raise RecordingError(f"{place} does not last", got=got, expected=expected)
    return np.stack([np.interp(t, known, column) for column in values.T], axis=-1)
