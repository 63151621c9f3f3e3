"""Episodes on disk: the only package that opens recording files. It needs numpy only.

    recording = recordings.read("episodes/ep_01")
    recordings.write(recording, "episodes/copy")

Readings of a tension machine are no episode: see ``ForceDisplacement``, ``read_tension`` and ``write_tension``.

A reader refuses data that it cannot trust, by a ``RecordingError`` of one line. A stream that is absent is None. Other
formats (ROS bags, LeRobot, Kinect, RGB-D folders) are read in ``torchcloth.recordings.formats``; a ROS bag in
``formats/ros2.py``.
"""

from __future__ import annotations

from .images import ImageStream
from .reading import read
from .tension import ForceDisplacement, read_tension, write_tension
from .types import (
    Camera,
    ClothInfo,
    Collider,
    GraspInfo,
    GripperMotion,
    JointMotion,
    Markers,
    PointClouds,
    Recording,
    RobotInfo,
    Truth,
)
from .writing import write

__all__ = [
    "Camera",
    "ClothInfo",
    "Collider",
    "ForceDisplacement",
    "GraspInfo",
    "GripperMotion",
    "ImageStream",
    "JointMotion",
    "Markers",
    "PointClouds",
    "Recording",
    "RobotInfo",
    "Truth",
    "read",
    "read_tension",
    "write",
    "write_tension",
]
