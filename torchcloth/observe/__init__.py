"""Depth cameras: rendering, noise, masks and point clouds; and a mesh laid onto what they saw.

To a camera a cloth is one more triangle mesh; only ``align`` knows its pattern.
"""

from .align import Alignment, align
from .camera import DepthCamera, look_at
from .cloud import erode, thin_to_count, thin_to_spacing, to_points
from .lens import Lens
from .noise import AbstractNoise, DepthNoise, lost_edges
from .render import render_depth
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
    "StereoNoise",
    "View",
    "align",
    "capture",
    "decode",
    "encode",
    "erode",
    "look_at",
    "lost_edges",
    "render_depth",
    "solid_mesh",
    "solid_meshes",
    "thin_to_count",
    "thin_to_spacing",
    "to_points",
]
