"""Episodes on disk: the only room that opens recording files. Needs numpy only.

    recording = recordings.read("episodes/ep_01")
    recordings.write(recording, "episodes/copy")

Readings of a tension machine are no episode: `ForceDisplacement`, `read_tension`, `write_tension`.

A reader refuses what it cannot trust, with a one-line `RecordingError`; a stream that is merely missing is None.
Other formats are read by `torchcloth.recordings.formats`.
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
