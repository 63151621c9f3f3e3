"""Cloth meshes: triangles with a rest shape in the fabric's own material axes."""

from .garments import dress, shirt, trousers
from .mesh import Mesh
from .shapes import load, rectangle

__all__ = ["Mesh", "dress", "load", "rectangle", "shirt", "trousers"]
