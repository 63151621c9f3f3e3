"""ROS 2 bags: rosbag2 folders, .mcap and .db3 files. The scene says which topic is what.

    "source": {
      "motion": {"left": {"pose": "/left/pose", "closed": "/left/closed" | true, "wrench": "/left/ft",
                          "wrench_frame": "world" | "gripper"},
                 "right": {"joints": {"topic": "/joint_states", "names": ["j1", ...], "width": "finger_joint"}}},
      "cameras": {"cam0": {"depth": TOPIC, "color": TOPIC, "mask": TOPIC, "info": TOPIC, "rectified": false}},
      "points": {"topic": "/cloth", "frame": "world" | CAMERA},
      "epoch": 1700000000000000000}

Poses, clouds and wrenches must be in the frame world or map, or their ``frame`` says where the scene places them.
Times are those of measurement (header.stamp), and since ``epoch`` [ns] or the earliest one used; messages without a
header (std_msgs) are placed by their time of logging. A value between two messages is interpolated for wrenches and
held for ``closed``.

Checksums: in an MCAP file with checksums of its sections (our own writer's) any changed byte is noticed; with those of
its chunks (as ROS 2 and the MCAP libraries write) any changed message. MCAP files by rosbags and all sqlite files carry
none: structure, counts and times are checked, but a changed number or pixel goes unnoticed where it stays plausible.
``source.checksums`` in the episode says which it was: "all bytes", "messages" or "none".
"""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any

from ...errors import RecordingError
from . import embedded
from .bag import Bag, is_bag
from .imported import Imported, nothing_left
from .ros2_cameras import CameraTopics
from .ros2_topics import CloudTopic, MotionTopics
from .sidecar import Scene

NAME = "ros2"
TITLE = "ROS 2 bag (rosbag2 folder, .mcap, .db3)"
UNCHECKED = {"all bytes": "", "messages": "", "none": "numbers and pixels"}
EXAMPLE = '"source": {"motion": {"left": {"pose": TOPIC, "closed": true}}, "points": {"topic": TOPIC}}'


def matches(path: Path) -> bool:
    """Whether it is a bag, by its content."""
    return is_bag(path)


def read(path: Path, scene: Scene, episode: int | None) -> Imported:
    """Read a bag; images are decoded when they are written."""
    bag = Bag(path)
    if embedded.SCENE in bag.types:
        embedded.adopt(scene, bag)
    source = scene.source
    if not source.rest:
        got = ", ".join(f"{topic} ({kind.rpartition('/')[2]})" for topic, kind in sorted(bag.types.items()))
        expected = f"the scene with {EXAMPLE}"
        raise RecordingError(f"{path}: no topic is mapped", got=f"the topics {got}", expected=expected)
    epoch = source.maybe(source.take, "epoch")
    if epoch is not None and (isinstance(epoch, bool) or not isinstance(epoch, int) or abs(epoch) > 2**62):
        raise RecordingError(f"{source.at('epoch')} is no time", got=epoch, expected="whole nanoseconds")
    origin = source.maybe(source.take, "origin")
    motion = {name: MotionTopics(fields, bag, scene) for name, fields in source.each("motion").items()}
    each = source.each("cameras")
    cameras = {name: CameraTopics(fields, bag, scene.depth_scale(name)) for name, fields in each.items()}
    clouds = CloudTopic(source.inside("points"), bag, scene) if source.has("points") else None
    nothing_left(source)
    parts = [*motion.values(), *cameras.values(), *([clouds] if clouds else [])]
    _hand_out(bag, parts)
    stamps = [stamp for part in parts for stamp in part.stamps()]
    start = epoch if epoch is not None else min(stamps, default=0)
    found = Imported(
        motion={name: part.arrays(start) for name, part in motion.items()},
        points=clouds.arrays(start) if clouds else None,
        cameras={name: part.camera(start) for name, part in cameras.items()},
        notes={
            "format": NAME,
            "start_ns": start,
            "checksums": bag.checksums,
            "unchecked": UNCHECKED[bag.checksums],
            **({} if origin is None else {"origin": origin}),
        },
    )
    return embedded.restore(found, scene)


def _hand_out(bag: Bag, parts: list[Any]) -> None:
    """Give each message to the parts that named its topic."""
    takers: defaultdict[str, list[Any]] = defaultdict(list)
    for part in parts:
        for topic in part.topics:
            takers[topic].append(part)
    for message in bag.messages(list(takers)):
        for part in takers[message.topic]:
            part.take(message)
