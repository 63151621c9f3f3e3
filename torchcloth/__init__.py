"""torchcloth: a differentiable cloth layer for robotics.

``tc.Cloth`` is the layer; ``tc.meshes``, ``tc.materials``, ``tc.effects``, ``tc.boundaries`` are its parts;
``tc.robots`` gives end-effector poses, ``tc.recordings`` episodes, ``tc.identify`` parameters with errors,
``tc.estimate_pose`` the mesh over time.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from . import boundaries, effects, errors, functional, losses, materials, meshes
from .cloth import Cloth
from .parameters import PhysicalParameter
from .sensitivities import Directions
from .transfer import Contact
from .types import ClothState, Rollout, Trajectory

if TYPE_CHECKING:
    from . import identification, observe, pose, recordings, robots
    from .identification import identify
    from .pose import estimate_pose

__version__ = "0.1.0"
__all__ = [
    "Cloth",
    "ClothState",
    "Contact",
    "Directions",
    "PhysicalParameter",
    "Rollout",
    "Trajectory",
    "boundaries",
    "effects",
    "errors",
    "estimate_pose",
    "functional",
    "identification",
    "identify",
    "losses",
    "materials",
    "meshes",
    "observe",
    "pose",
    "recordings",
    "robots",
]


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])


def __getattr__(name: str):
    """Rooms that are opened when they are first asked for: importing the layer stays cheap."""
    if name in ("identification", "observe", "pose", "recordings", "robots"):
        return import_module(f".{name}", __name__)
    if name == "identify":
        return import_module(".identification", __name__).identify
    if name == "estimate_pose":
        return import_module(".pose", __name__).estimate_pose
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
