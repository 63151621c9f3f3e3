"""Episodes on disk: the only room that opens recording files. Needs numpy only.

    recording = recordings.read("episodes/ep_01")
    recordings.write(recording, "episodes/copy")

A reader refuses what it cannot trust, with a one-line `RecordingError`; a stream that is merely missing is None.
Other formats are read by `torchcloth.recordings.formats`.
"""

from __future__ import annotations

from .images import ImageStream
from .reading import read
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
    "write",
]
