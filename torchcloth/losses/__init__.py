"""Distances between simulated surfaces and measured points. Every convention has its own name."""

from .surface import Hits, chamfer_to_surface, closest, residuals
from .vertices import chamfer_to_vertices

__all__ = ["Hits", "chamfer_to_surface", "chamfer_to_vertices", "closest", "residuals"]
