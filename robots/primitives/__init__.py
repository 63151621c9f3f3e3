"""Eight families of robot motion with cloth, as paths of the grippers.

``cover``, ``drag``, ``fold`` and ``hang`` start with cloth on the table, the others (``fling``, ``stretch``, ``swing``,
``shake``) with hanging cloth. World: z up, the table's top at z = 0. ``robots.plan`` computes joint motions for a path.
"""

from __future__ import annotations

from ..trajectories import minimum_jerk
from .base import Action, GripperLimits
from .cover import cover
from .drag import drag
from .fling import fling
from .fold import fold
from .hang import hang
from .shake import shake
from .stretch import stretch
from .swing import swing

__all__ = [
    "Action",
    "GripperLimits",
    "cover",
    "drag",
    "fling",
    "fold",
    "hang",
    "minimum_jerk",
    "shake",
    "stretch",
    "swing",
]
