"""Depth cameras: rendering, noise, masks and point clouds; and a mesh laid onto what they saw.

To a camera a cloth is one more triangle mesh; only ``align`` knows its pattern.
"""

from .align import Alignment, align
from .camera import DepthCamera, look_at
from .cloud import erode, thin_to_count, thin_to_spacing, to_points
from .lens import Lens
from .noise import AbstractNoise, DepthNoise, lost_edges
from .register import colors_at, reproject, steep
from .render import render_depth
from .segment import Segmentation, Segmented, segment, segment_depth
from .solids import solid_mesh, solid_meshes
from .stereo import StereoNoise
from .view import Capture, View, capture, decode, encode

__all__ = [
    "AbstractNoise",
    "Alignment",
    "Capture",
    "DepthCamera",
    "DepthNoise",
    "Lens",
    "Segmentation",
    "Segmented",
    "StereoNoise",
    "View",
    "align",
    "capture",
    "colors_at",
    "decode",
    "encode",
    "erode",
    "look_at",
    "lost_edges",
    "render_depth",
    "reproject",
    "segment",
    "segment_depth",
    "solid_mesh",
    "solid_meshes",
    "steep",
    "thin_to_count",
    "thin_to_spacing",
    "to_points",
]
