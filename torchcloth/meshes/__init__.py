"""Cloth meshes: triangles with a rest shape in the fabric's own material axes."""

from .mesh import Mesh
from .shapes import load, rectangle

__all__ = ["Mesh", "load", "rectangle"]
