"""Inspect a recording before anything is fitted to it: its content, and how far it can be trusted.

report = inspection.inspect(recordings.read("episodes/ep_01"))
inspection.show(report)
inspection.draw(report, "out/ep_01")
"""

from ..recordings.timing import StreamTiming
from .camera_from_arm import find_camera_pose_from_arms
from .depth_images import DepthSummary
from .frame_checks import FrameChecks
from .inspect_recording import Inspection, inspect
from .inspection_figure import draw
from .inspection_tables import show
from .lag import LagEstimate
from .noise import NoiseEstimate

__all__ = [
    "DepthSummary",
    "FrameChecks",
    "Inspection",
    "LagEstimate",
    "NoiseEstimate",
    "StreamTiming",
    "draw",
    "find_camera_pose_from_arms",
    "inspect",
    "show",
]
