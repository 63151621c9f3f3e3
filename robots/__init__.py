"""Robots: kinematics from URDF, ours or the user's own, as differentiable torch modules."""

if __name__ != "torchcloth.robots":
    raise ImportError(f"got {__name__!r}; import this package as torchcloth.robots")

from .arm import Arm, Limits, Primitive, load
from .description import models
from .replay import arm_of, replay
from .scene import Scene, bimanual_rig

__all__ = ["Arm", "Limits", "Primitive", "Scene", "arm_of", "bimanual_rig", "load", "models", "replay"]
