"""Depth cameras: rendering, noise, masks and point clouds; and a mesh laid onto what they saw.

To a camera a cloth is one more triangle mesh; only ``align`` knows its pattern.
"""

from .align import Alignment, align
from .camera import DepthCamera, look_at
from .cloud import erode, thin_to_count, thin_to_spacing, to_points
from .noise import DepthNoise, lost_edges
from .render import render_depth
from .solids import solid_mesh

__all__ = [
    "Alignment",
    "DepthCamera",
    "DepthNoise",
    "align",
    "erode",
    "look_at",
    "lost_edges",
    "render_depth",
    "solid_mesh",
    "thin_to_count",
    "thin_to_spacing",
    "to_points",
]
