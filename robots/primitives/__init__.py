"""What a robot does with cloth that it holds: eight families of motion, as paths of the grippers.

``cover``, ``drag``, ``fold`` and ``hang`` start with cloth on the table, the others (``fling``, ``stretch``, ``swing``,
``shake``) with cloth that hangs. World: z up, the table's top at z = 0. ``robots.plan`` gives joint motions for a path.
"""

from __future__ import annotations

from .base import Action, Limits, minimum_jerk
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
    "Limits",
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
