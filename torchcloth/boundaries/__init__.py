"""Where the cloth meets the world: grasps and colliders, applied in order. Motion is an input, never an attribute."""

from .base import AbstractBoundary, Drive
from .grasp import Grasp
from .motion import drive
from .plane import Plane

__all__ = ["AbstractBoundary", "Drive", "Grasp", "Plane", "drive"]
