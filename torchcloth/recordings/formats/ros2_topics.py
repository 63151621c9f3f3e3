"""What the topics of a ROS 2 bag say of one gripper or arm, and of the cloth's points."""

from __future__ import annotations

import numpy as np

from ...errors import RecordingError
from .. import checks
from ..checks import Fields
from . import ros2_messages
from .bag import Bag, Message
from .imported import nothing_left, pose_matrix, quaternions, seconds
from .sidecar import Scene

WORLD = ("world", "map")
EDGE = 0.1  # s; a wrench may begin this much after the first knot, or end before the last


def topic(fields: Fields, key: str, bag: Bag, *kinds: str) -> str:
    """A topic of the bag that holds one of these messages."""
    name = fields.text(key)
    if name not in bag.types:
        raise RecordingError(
            f"{fields.at(key)} is not in the bag", got=repr(name), expected=f"one of {sorted(bag.types)}"
        )
    if bag.types[name].rpartition("/")[2] not in kinds:
        raise RecordingError(f"{fields.at(key)} is of another type", got=bag.types[name], expected=" or ".join(kinds))
    return name


def in_world(fields: Fields, scene: Scene) -> np.ndarray | None:
    """The pose of the frame that the mapping names; None when it names none."""
    frame = fields.maybe(fields.text, "frame")
    return None if frame is None else scene.transform(frame)


def must_be_world(message: Message, frame: np.ndarray | None, remedy: str) -> None:
    """Refuse a message of another frame than the world's, unless the mapping placed it, and then one of the world's."""
    found = message.body.header.frame_id
    if frame is not None and not np.array_equal(frame, np.eye(4)) and found.strip("/") in WORLD:
        raise RecordingError(
            f"{message.place} is in the world already",
            got=repr(found),
            expected="another frame",
            remedy="leave out frame, or let the driver say which frame it means",
        )
    if frame is None and found.strip("/") not in WORLD:
        raise RecordingError(
            f"{message.place} is in another frame", got=repr(found), expected="world or map", remedy=remedy
        )


class MotionTopics:
    """The topics of one gripper or arm: a pose or joint states, with what goes along."""

    def __init__(self, fields: Fields, bag: Bag, scene: Scene) -> None:
        self.place = fields.place
        self.pose = topic(fields, "pose", bag, "PoseStamped") if fields.has("pose") else None
        self.frame = in_world(fields, scene)
        self.joints = Joints(fields.inside("joints"), bag) if fields.has("joints") else None
        if self.pose is None and self.joints is None:
            raise RecordingError(f"{self.place} has no motion", got=sorted(fields.rest), expected="pose or joints")
        self.closed = Closed(fields, bag)
        self.wrench = topic(fields, "wrench", bag, "WrenchStamped") if fields.has("wrench") else None
        self.wrench_frame = fields.text("wrench_frame") if self.wrench else None
        if self.wrench_frame not in (None, "world", "gripper") or (self.wrench_frame == "gripper" and not self.pose):
            got, expected = self.wrench_frame, "world, or gripper where there is a pose"
            raise RecordingError(f"{fields.at('wrench_frame')} is unclear", got=got, expected=expected)
        nothing_left(fields)
        joints = self.joints.topic if self.joints else None
        self.topics = [t for t in (self.pose, joints, self.closed.topic, self.wrench) if t]
        self._poses: list[tuple[int, int, np.ndarray]] = []  # measured and logged at [ns], position and quaternion
        self._wrenches: list[tuple[int, np.ndarray]] = []

    def take(self, message: Message) -> None:
        """Keep what a message says."""
        body = message.body
        if message.topic == self.closed.topic:
            self.closed.take(message)
        elif message.topic == self.pose:
            must_be_world(message, self.frame, f'set "frame" in {self.place}')
            pose = [ros2_messages.position(body.pose.position), ros2_messages.quaternion(body.pose.orientation)]
            self._poses.append((ros2_messages.stamp(body, message.place), message.logged, np.concatenate(pose)))
        elif message.topic == self.wrench:
            if self.wrench_frame == "world":
                remedy = f'set "frame" in {self.place}, or "wrench_frame": "gripper"'
                must_be_world(message, self.frame, remedy)
            both = [ros2_messages.position(body.wrench.force), ros2_messages.position(body.wrench.torque)]
            self._wrenches.append((ros2_messages.stamp(body, message.place), np.concatenate(both)))
        elif self.joints:
            self.joints.take(message)

    def stamps(self) -> list[int]:
        """Times of measurement [ns]."""
        return [pose[0] for pose in self._poses] + (self.joints.stamps() if self.joints else [])

    def arrays(self, start: int) -> dict[str, np.ndarray]:
        """The arrays of motion.npz."""
        out: dict[str, np.ndarray] = {}
        if self.joints:
            out, logged = self.joints.arrays(start), self.joints.logged()
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

    def _pose_arrays(self, start: int) -> dict[str, np.ndarray]:
        if not self._poses:
            raise RecordingError(f"{self.place}: {self.pose} is empty", expected="poses")
        values = np.array([p[2] for p in self._poses])
        position, quat = values[:, :3], values[:, 3:]
        if self.frame is not None and not np.array_equal(self.frame, np.eye(4)):
            turned = self.frame @ pose_matrix(position, quat, self.place)
            position, quat = turned[:, :3, 3], quaternions(turned[:, :3, :3])
        return {"t": seconds([p[0] for p in self._poses], start), "position": position, "quat_wxyz": quat}

    def _wrench_arrays(self, out: dict[str, np.ndarray], start: int) -> dict[str, np.ndarray]:
        """Force and torque at the knots; a half that is NaN throughout was not measured."""
        known = seconds([s for s, _ in self._wrenches], start)
        halves = {"force": slice(0, 3), "torque": slice(3, 6)}
        values = np.array([w for _, w in self._wrenches])
        found = {}
        for key, half in halves.items():
            if np.isnan(values[:, half]).all():
                continue
            at_knots = between(out["t"], known, values[:, half], f"{self.place}: {self.wrench}")
            if self.wrench_frame == "gripper":
                turns = pose_matrix(out["position"], out["quat_wxyz"], self.place)[:, :3, :3]
                at_knots = np.einsum("kij,kj->ki", turns, at_knots)
            elif self.frame is not None:  # as the poses; the torque's point is the gripper in every frame
                at_knots = at_knots @ self.frame[:3, :3].T
            found[key] = at_knots
        return found


class Joints:
    """The joint states of one arm; messages that hold none of its joints are another's."""

    def __init__(self, fields: Fields, bag: Bag) -> None:
        self.place = fields.place
        self.topic = topic(fields, "topic", bag, "JointState")
        names = fields.take("names")
        if not isinstance(names, list) or not names or not all(isinstance(n, str) for n in names):
            raise RecordingError(f"{fields.at('names')} is unclear", got=names, expected="joint names, in order")
        self.width = fields.maybe(fields.text, "width")
        nothing_left(fields)
        self.names = [*names, *([self.width] if self.width else [])]
        self._states: list[tuple[int, int, list[float]]] = []

    def take(self, message: Message) -> None:
        """Keep what a message says."""
        body = message.body
        values = dict(zip(body.name, np.asarray(body.position, dtype=float).tolist(), strict=False))
        missing = [n for n in self.names if n not in values]
        if len(missing) == len(self.names):
            return
        if missing or len(values) < len(body.name):
            raise RecordingError(f"{message.place} lacks joints", got=missing or "fewer positions than names")
        state = [values[n] for n in self.names]
        self._states.append((ros2_messages.stamp(body, message.place), message.logged, state))

    def stamps(self) -> list[int]:
        """Times of measurement [ns]."""
        return [state[0] for state in self._states]

    def logged(self) -> list[int]:
        """Times of logging [ns]."""
        return [state[1] for state in self._states]

    def arrays(self, start: int) -> dict[str, np.ndarray]:
        """t, q and width as in motion.npz."""
        if not self._states:
            raise RecordingError(f"{self.place}: no message of {self.topic} holds the joints", got=self.names)
        values = np.array([state[2] for state in self._states])
        t = seconds(self.stamps(), start)
        return {"t": t, "q": values[:, :-1], "width": values[:, -1]} if self.width else {"t": t, "q": values}


class Closed:
    """When a gripper holds: a constant, or a topic of std_msgs/Bool held until its next message."""

    def __init__(self, fields: Fields, bag: Bag) -> None:
        value = fields.rest.get("closed")
        self.constant = value if isinstance(value, bool) else None
        self.topic = topic(fields, "closed", bag, "Bool") if isinstance(value, str) else None
        if value is not None and self.topic is None and self.constant is None:
            raise RecordingError(f"{fields.at('closed')} is unclear", got=value, expected="a topic, true or false")
        fields.rest.pop("closed", None)
        self._events: list[tuple[int, bool]] = []

    def take(self, message: Message) -> None:
        """Keep a change."""
        self._events.append((message.logged, bool(message.body.data)))

    def at(self, logged: list[int], place: str) -> np.ndarray | None:
        """Whether it holds at these times of logging [K] ns."""
        if self.topic is None:
            return None if self.constant is None else np.full(len(logged), self.constant)
        times = np.array([t for t, _ in self._events], dtype=np.int64)
        index = np.searchsorted(times, np.asarray(logged, dtype=np.int64), side="right") - 1
        if not len(times) or index.min() < 0:
            remedy = 'or write "closed": true'
            raise RecordingError(f"{place}: {self.topic} begins late", expected="before the motion", remedy=remedy)
        return np.array([value for _, value in self._events])[index]


class CloudTopic:
    """Segmented cloth points."""

    def __init__(self, fields: Fields, bag: Bag, scene: Scene) -> None:
        self.place = fields.place
        self.topic = topic(fields, "topic", bag, "PointCloud2")
        self.frame = in_world(fields, scene)
        nothing_left(fields)
        self.topics = [self.topic]
        self._clouds: list[tuple[int, np.ndarray]] = []

    def take(self, message: Message) -> None:
        """Keep a cloud; one without a point is left out."""
        must_be_world(message, self.frame, f'set "frame" in {self.place}')
        xyz = ros2_messages.cloud(message.body, message.place)
        if len(xyz):
            self._clouds.append((ros2_messages.stamp(message.body, message.place), xyz))

    def stamps(self) -> list[int]:
        """Times of measurement [ns]."""
        return [cloud[0] for cloud in self._clouds]

    def arrays(self, start: int) -> dict[str, np.ndarray]:
        """The arrays of points.npz."""
        if not self._clouds:
            raise RecordingError(f"{self.place}: {self.topic} holds no point", expected="clouds of the cloth")
        xyz = np.concatenate([cloud for _, cloud in self._clouds])
        if self.frame is not None and not np.array_equal(self.frame, np.eye(4)):
            xyz = xyz @ self.frame[:3, :3].T + self.frame[:3, 3]
        counts = np.array([len(cloud) for _, cloud in self._clouds])
        return {"t": seconds(self.stamps(), start), "xyz": xyz, "counts": counts}


def between(t: np.ndarray, known: np.ndarray, values: np.ndarray, place: str) -> np.ndarray:
    """Values [K, D] at ``t`` by linear interpolation."""
    checks.increasing(known, f"{place}: its times")
    if t[0] < known[0] - EDGE or t[-1] > known[-1] + EDGE:
        got, expected = f"{known[0]:.6g} to {known[-1]:.6g} s", f"{t[0]:.6g} to {t[-1]:.6g} s, as the motion"
        raise RecordingError(f"{place} does not last", got=got, expected=expected)
    return np.stack([np.interp(t, known, column) for column in values.T], axis=-1)
