"""Robots: kinematics from URDF as differentiable torch modules, families of motion, and joint plans for them."""

if __name__ != "torchcloth.robots":
    raise ImportError(f"got {__name__!r}; import this package as torchcloth.robots")

from . import primitives
from .arm import Arm, Primitive, load
from .chain import JointLimits, SerialChain
from .description import list_models
from .grasp_orientations import GraspOrientation
from .plan import DEFAULT_JOINT_ACCELERATION, JointPlan, plan
from .replan_episode import joint_motion_for_episode
from .replay import arm_from_recording, list_closing_grippers, replay, to_gripper_motion
from .scene import Scene, Table, bimanual_rig

__all__ = [
    "DEFAULT_JOINT_ACCELERATION",
    "Arm",
    "GraspOrientation",
    "JointLimits",
    "JointPlan",
    "Primitive",
    "Scene",
    "SerialChain",
    "Table",
    "arm_from_recording",
    "bimanual_rig",
    "joint_motion_for_episode",
    "list_closing_grippers",
    "list_models",
    "load",
    "plan",
    "primitives",
    "replay",
    "to_gripper_motion",
]
