"""Shake: hanging cloth is moved up and down fast."""

from __future__ import annotations

import math

from .base import Action, Grips, Limits, finite
from .swing import to_and_fro


def shake(
    grips: Grips,
    amplitude: float = 0.03,
    *,
    cycles: int = 4,
    period: float = 0.4,
    elevation: float = math.pi / 2,
    heading: float = 0.0,
    rest: float = 0.4,
    limits: Limits = Limits(),  # noqa: B008 - immutable
) -> Action:
    """Shake hanging cloth, to take out its creases: short ways, fast, up and down unless told otherwise.

    Args:
        grips: where the grippers hold, at the start.
        amplitude: to either side of the start [m].
        cycles: how often.
        period: of one cycle, if the limits allow [s].
        elevation: of the direction above the horizontal [rad]; 0 shakes along the heading.
        heading: from the world's x axis [rad].
        rest: time at the end [s].
        limits: of the grippers.

    Raises:
        InvalidInput: a value that gives no motion, or a path through the table.
    """
    finite(elevation=elevation, heading=heading)
    flat = math.cos(elevation)
    direction = (flat * math.cos(heading), flat * math.sin(heading), math.sin(elevation))
    return to_and_fro(grips, amplitude, direction, cycles, period, heading, rest, limits)
