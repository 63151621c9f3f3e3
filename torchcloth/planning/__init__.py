"""Trajectory optimisation: motions of the grippers after which the cloth lies where it shall."""

from .goal import Goal, read_goal
from .plan import plan
from .result import MotionPlan
from .tables import print_plan

__all__ = ["Goal", "MotionPlan", "plan", "print_plan", "read_goal"]
