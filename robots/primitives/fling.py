"""Fling: hanging cloth is swung back and forward and laid down."""

from __future__ import annotations

import math

from .base import Action, Grips, Limits, Move, action, along, check, finite, lowest


def fling(
    grips: Grips,
    swing: float = 0.3,
    *,
    heading: float = -math.pi / 2,
    landing: float = 0.03,
    pull: float = 0.3,
    rest: float = 0.4,
    limits: Limits = Limits(),  # noqa: B008 - immutable
) -> Action:
    """Swing hanging cloth back and forward, lay it down while drawing back, open, wait.

    Args:
        grips: where the grippers hold, high above the table.
        swing: to either side of the start [m].
        heading: forward, from the world's x axis [rad].
        landing: the grip's height where it opens [m].
        pull: horizontal way while going down, against the heading [m].
        rest: time after opening [s].
        limits: of the grippers.

    Raises:
        InvalidInput: a value that gives no motion, or a path through the table.
    """
    check(swing=swing, landing=landing)
    finite(pull=pull)
    drop = landing - lowest(grips)
    check(**{"grips' height over the landing": -drop})
    shifts = [along(heading, -swing), along(heading, 2 * swing), along(heading, -pull, drop)]
    moves = [Move(shift) for shift in shifts]
    return action(grips, moves, heading, rest, limits)
