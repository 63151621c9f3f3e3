"""Estimate the full mesh of a cloth over time from recordings that show a part of it."""

from .estimate import estimate_pose
from .result import PoseEstimate

__all__ = ["PoseEstimate", "estimate_pose"]
