"""torchcloth: a differentiable cloth layer for robotics.

import torchcloth as tc

``tc.Cloth`` is the layer; ``tc.meshes``, ``tc.materials``, ``tc.effects``, ``tc.boundaries`` are its parts;
``tc.robots`` gives end-effector poses, ``tc.recordings`` episodes, ``tc.identify`` parameters with errors.
"""

from . import boundaries, effects, errors, functional, materials, meshes
from .cloth import Cloth
from .parameters import PhysicalParameter
from .transfer import Contact
from .types import ClothState, Rollout, Trajectory

__version__ = "0.1.0"
__all__ = [
    "Cloth",
    "ClothState",
    "Contact",
    "PhysicalParameter",
    "Rollout",
    "Trajectory",
    "boundaries",
    "effects",
    "errors",
    "functional",
    "materials",
    "meshes",
]
