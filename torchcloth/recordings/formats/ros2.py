"""ROS bags are read here: rosbag2 folders, .mcap, .db3 and .bag files. The scene says what each topic is.

    "source": {
      "motion": {"left": {"pose": "/left/pose", "closed": "/left/closed" | true, "wrench": "/left/ft",
                          "wrench_frame": "world" | "gripper"},
                 "right": {"joints": {"topic": "/joint_states", "names": ["j1", ...], "width": "finger_joint"}}},
      "cameras": {"cam0": {"depth": TOPIC, "color": TOPIC, "mask": TOPIC, "info": TOPIC, "rectified": false}},
      "points": {"topic": "/cloth", "frame": "world" | CAMERA},
      "epoch": 1700000000000000000}

Poses, clouds and wrenches must be in the frame world or map, or their ``frame`` names a camera or robot that the scene
places. Times are those of measurement (header.stamp), relative to ``epoch`` [ns] or to the earliest one used. Messages
without a header (std_msgs) are placed by their time of logging. Wrenches are interpolated between messages; ``closed``
is constant until the next message. A message that repeats another one's stamp and content is left out, and messages out
of order are sorted by their stamps; ``source.repairs`` in the episode says so.

Checksums: in an MCAP file with checksums of its sections (our own writer's) any changed byte is detected. With
checksums of its chunks (as ROS 2 and the MCAP libraries write them) any changed message is. MCAP files by rosbags, all
sqlite files and bags of ROS 1 carry none: structure, counts and times are checked, but a changed number or pixel goes
unnoticed if it stays plausible. ``source.checksums`` in the episode says which it was: "all bytes", "messages" or
"none".

The work is shared: ``bag`` opens the files, ``ros2_messages`` decodes single messages, ``ros2_topics`` and
``ros2_cameras`` collect those of one gripper or camera, ``embedded`` restores files by our own writer.
"""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any

from ...errors import RecordingError
from . import embedded
from .bag import Bag, is_bag
from .imported import Imported, Importer, reject_unknown_keys, report_damage
from .ros2_cameras import CameraTopics
from .ros2_topics import CloudTopic, MotionTopics
from .scene_file import SceneFile

ROS2_NAME = "ros2"
ROS2_TITLE = "ROS bag (rosbag2 folder, .mcap, .db3, or .bag of ROS 1)"
ROS2_UNCHECKED = {"all bytes": "", "messages": "", "none": "numbers and pixels"}
ROS2_SOURCE_EXAMPLE = '"source": {"motion": {"left": {"pose": TOPIC, "closed": true}}, "points": {"topic": TOPIC}}'


def matches(path: Path) -> bool:
    """Return whether a path is a ROS bag, by its content."""
    return is_bag(path)


def read(path: Path, scene: SceneFile, episode: int | None) -> Imported:
    """Read a bag; images are decoded when they are written.

    Args:
        path: a rosbag2 folder, or a .mcap, .db3 or .bag file.
        scene: the scene file with ``source``.
        episode: unused; a bag holds one episode.

    Raises:
        RecordingError: the bag is damaged, or the scene maps no topic or a wrong one.
    """
    bag = Bag(path)
    if embedded.SCENE_TOPIC in bag.types:
        embedded.adopt_scene_file(scene, bag)
    source = scene.source
    if not source.remaining:
        got = ", ".join(f"{topic} ({kind.rpartition('/')[2]})" for topic, kind in sorted(bag.types.items()))
        expected = f"the scene with {ROS2_SOURCE_EXAMPLE}"
        raise RecordingError(f"{path}: no topic is mapped", got=f"the topics {got}", expected=expected)
    epoch = source.optional(source.take, "epoch")
    if epoch is not None and (isinstance(epoch, bool) or not isinstance(epoch, int) or abs(epoch) > 2**62):
        raise RecordingError(f"{source.location('epoch')} is no time", got=epoch, expected="whole nanoseconds")
    origin = source.optional(source.take, "origin")
    motion = {name: MotionTopics(fields, bag, scene) for name, fields in source.named_groups("motion").items()}
    each = source.named_groups("cameras")
    cameras = {name: CameraTopics(fields, bag, scene.depth_scale(name)) for name, fields in each.items()}
    clouds = CloudTopic(source.group("points"), bag, scene) if source.has("points") else None
    reject_unknown_keys(source)
    parts = [*motion.values(), *cameras.values(), *([clouds] if clouds else [])]
    _distribute_messages(bag, parts)
    stamps = [stamp for part in parts for stamp in part.stamps()]
    start = epoch if epoch is not None else min(stamps, default=0)
    imported = Imported(
        motion={name: part.arrays(start) for name, part in motion.items()},
        points=clouds.arrays(start) if clouds else None,
        cameras={name: part.camera(start) for name, part in cameras.items()},
        notes={
            "format": ROS2_NAME,
            "start_ns": start,
            "checksums": bag.checksums,
            "unchecked": ROS2_UNCHECKED[bag.checksums],
            **({} if origin is None else {"origin": origin}),
        },
    )
    notes = bag.notes + [note for part in parts for note in part.notes]
    if notes:
        imported.notes["repairs"] = notes
    return embedded.restore_files(imported, scene)


def _distribute_messages(bag: Bag, parts: list[Any]) -> None:
    """Give each message to the parts that named its topic."""
    takers: defaultdict[str, list[Any]] = defaultdict(list)
    for part in parts:
        for topic in part.topics:
            takers[topic].append(part)
    for message in bag.messages(list(takers)):
        for part in takers[message.topic]:
            with report_damage(message.place, f"message of type {bag.types[message.topic]}"):  # a bag defines its types
                part.take(message)


ROS2_IMPORTER = Importer(ROS2_NAME, ROS2_TITLE, matches, read)
