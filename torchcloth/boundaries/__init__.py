"""Grasps and colliders, applied in order. Their motion is an input of the simulation, never an attribute."""

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
    "Elliptic",
    "Grasp",
    "MeshSolid",
    "Plane",
    "PrescribedMotion",
    "Sphere",
    "Stribeck",
    "sample_trajectory",
]
