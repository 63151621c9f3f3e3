"""Simulated depth cameras: rendering, noise, masks and point clouds.

Nothing here knows cloth: a cloth is one more triangle mesh.
"""

from .camera import DepthCamera, look_at
from .cloud import erode, thin_to_count, thin_to_spacing, to_points
from .noise import DepthNoise, lost_edges
from .render import render_depth
from .solids import solid_mesh

__all__ = [
    "DepthCamera",
    "DepthNoise",
    "erode",
    "look_at",
    "lost_edges",
    "render_depth",
    "solid_mesh",
    "thin_to_count",
    "thin_to_spacing",
    "to_points",
]
