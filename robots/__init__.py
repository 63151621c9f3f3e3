"""Robots: kinematics from URDF as differentiable torch modules, families of motion, and plans for them."""

if __name__ != "torchcloth.robots":
    raise ImportError(f"got {__name__!r}; import this package as torchcloth.robots")

from . import primitives
from .arm import Arm, Limits, Primitive, load
from .description import models
from .grasp_orientations import Hold
from .plan import ACCELERATION, Plan, plan
from .replan_episode import retrace
from .replay import arm_of, closing, gripper_motion, replay
from .scene import Scene, Table, bimanual_rig

__all__ = [
    "ACCELERATION",
    "Arm",
    "Hold",
    "Limits",
    "Plan",
    "Primitive",
    "Scene",
    "Table",
    "arm_of",
    "bimanual_rig",
    "closing",
    "gripper_motion",
    "load",
    "models",
    "plan",
    "primitives",
    "replay",
    "retrace",
]
