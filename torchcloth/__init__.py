"""torchcloth: a differentiable cloth layer for robotics.

``tc.Cloth`` is the layer; ``tc.meshes``, ``tc.materials``, ``tc.effects``, ``tc.boundaries`` are its parts;
``tc.robots`` gives end-effector poses, ``tc.recordings`` episodes, ``tc.identify`` parameters with errors,
``tc.estimate_pose`` the mesh over time. ``tc.diagnose`` names what a simulation of episodes gets wrong, and ``tc.load``
reads the extended model that it wrote. ``tc.plan`` finds a motion that brings the cloth to a goal.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from . import boundaries, dynamics, effects, errors, losses, materials, meshes
from .cloth import Cloth
from .dynamics.contact import Contact
from .parameters import PhysicalParameter
from .simulation.sensitivities import Directions
from .types import ClothState, Rollout, Trajectory

if TYPE_CHECKING:
    from . import diagnosis, export, identification, observe, planning, pose, recordings, robots
    from .diagnosis import diagnose, load
    from .identification import identify
    from .planning import plan
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
    "diagnose",
    "diagnosis",
    "dynamics",
    "effects",
    "errors",
    "estimate_pose",
    "export",
    "identification",
    "identify",
    "load",
    "losses",
    "materials",
    "meshes",
    "observe",
    "plan",
    "planning",
    "pose",
    "recordings",
    "robots",
]

LAZY_SUBPACKAGES = ("diagnosis", "export", "identification", "observe", "planning", "pose", "recordings", "robots")
LAZY_FUNCTIONS = {
    "diagnose": "diagnosis",
    "estimate_pose": "pose",
    "identify": "identification",
    "load": "diagnosis",
    "plan": "planning",
}  # function: its subpackage


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])


def __getattr__(name: str):
    """Import a subpackage or function when it is first used, so that importing the layer stays cheap."""
    if name in LAZY_SUBPACKAGES:
        return import_module(f".{name}", __name__)
    if name in LAZY_FUNCTIONS:
        return getattr(import_module(f".{LAZY_FUNCTIONS[name]}", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
