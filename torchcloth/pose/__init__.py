"""Estimate the full mesh of a cloth over time from recordings that show a part of it."""

from .estimate import estimate_pose
from .first_shape import FirstShape, estimate_first_shape, load_network, save_network
from .network import PoseEstimator, PoseNetworkConfig, PosePrediction
from .result import PoseEstimate
from .scene_frame import PoseInputs, move_to_grippers, rest_coordinates

__all__ = [
    "FirstShape",
    "PoseEstimate",
    "PoseEstimator",
    "PoseInputs",
    "PoseNetworkConfig",
    "PosePrediction",
    "estimate_first_shape",
    "estimate_pose",
    "load_network",
    "move_to_grippers",
    "rest_coordinates",
    "save_network",
]
