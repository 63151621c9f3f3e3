"""Where the cloth meets the world: grasps and colliders, applied in order. Motion is an input, never an attribute."""

from .base import AbstractBoundary, PrescribedMotion
from .collider import AbstractCollider
from .friction import Coulomb, Elliptic, Stribeck
from .grasp import Grasp
from .mesh_solid import MeshSolid
from .motion import sample_trajectory
from .plane import Plane
from .solids import Box, Capsule, Cylinder, Sphere

__all__ = [
    "AbstractBoundary",
    "AbstractCollider",
    "Box",
    "Capsule",
    "Coulomb",
    "Cylinder",
    "PrescribedMotion",
    "Elliptic",
    "Grasp",
    "MeshSolid",
    "Plane",
    "Sphere",
    "Stribeck",
    "sample_trajectory",
]
