"""Distances between simulated surfaces and measured points; every convention has its own name."""

from .surface import ClosestPoints, chamfer_to_surface, find_closest_points, residuals
from .vertices import chamfer_to_vertices

__all__ = ["ClosestPoints", "chamfer_to_surface", "chamfer_to_vertices", "find_closest_points", "residuals"]
