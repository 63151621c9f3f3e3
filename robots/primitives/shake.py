"""Shake: hanging cloth is moved fast over a short distance."""

from __future__ import annotations

import math

from .base import Action, GripperLimits, Grips, check_finite
from .swing import build_oscillation


def shake(
    grips: Grips,
    amplitude: float = 0.03,
    *,
    cycles: int = 4,
    period: float = 0.4,
    elevation: float = math.pi / 2,
    heading: float = 0.0,
    rest: float = 0.4,
    limits: GripperLimits = GripperLimits(),  # noqa: B008 - immutable
) -> Action:
    """Shake hanging cloth to remove its creases: short fast moves, up and down by default.

    Args:
        grips: where the grippers hold, at the start.
        amplitude: m, to either side of the start.
        cycles: number of cycles.
        period: s, of one cycle, if the limits allow it.
        elevation: rad, of the direction above the horizontal; 0 shakes along the heading.
        heading: rad, from the world's x axis.
        rest: s, time at the end.
        limits: of the grippers.

    Raises:
        InvalidInput: a value that defines no motion, or a path through the table.
    """
    check_finite(elevation=elevation, heading=heading)
    flat = math.cos(elevation)
    direction = (flat * math.cos(heading), flat * math.sin(heading), math.sin(elevation))
    return build_oscillation(grips, amplitude, direction, cycles, period, heading, rest, limits)
