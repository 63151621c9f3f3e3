"""Depth cameras: rendering, noise, segmentation and point clouds, and the alignment of a mesh to a cloud.

To a camera a cloth is one more triangle mesh; only ``align`` knows its pattern.
"""

from .align import Alignment, align
from .camera import DepthCamera, look_at
from .camera_pose import CameraPose, CameraPosePriors, find_camera_pose
from .cloud import erode, thin_to_count, thin_to_spacing, to_points
from .lens import Lens
from .noise import AbstractNoise, DepthNoise, mask_depth_edges
from .register import mask_steep_pixels, reproject, sample_colors
from .render import render_depth
from .segment import Segmentation, SegmentedCloud, segment, segment_depth
from .solids import build_solid_mesh, build_solid_meshes
from .stereo import StereoNoise
from .view import Capture, View, capture, decode_depth, encode_depth

__all__ = [
    "AbstractNoise",
    "Alignment",
    "CameraPose",
    "CameraPosePriors",
    "Capture",
    "DepthCamera",
    "DepthNoise",
    "Lens",
    "Segmentation",
    "SegmentedCloud",
    "StereoNoise",
    "View",
    "align",
    "build_solid_mesh",
    "build_solid_meshes",
    "capture",
    "decode_depth",
    "encode_depth",
    "erode",
    "find_camera_pose",
    "look_at",
    "mask_depth_edges",
    "mask_steep_pixels",
    "render_depth",
    "reproject",
    "sample_colors",
    "segment",
    "segment_depth",
    "thin_to_count",
    "thin_to_spacing",
    "to_points",
]
