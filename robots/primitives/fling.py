"""Fling: hanging cloth is swung back and forward and laid down."""

from __future__ import annotations

import math

from .base import (
    Action,
    GripperLimits,
    Grips,
    Move,
    build_action,
    check_finite,
    check_positive,
    horizontal_shift,
    min_grip_height,
)


def fling(
    grips: Grips,
    swing: float = 0.3,
    *,
    heading: float = -math.pi / 2,
    landing: float = 0.03,
    pull: float = 0.3,
    rest: float = 0.4,
    limits: GripperLimits = GripperLimits(),  # noqa: B008 - immutable
) -> Action:
    """Swing hanging cloth back and forward, lay it down while drawing back, open, wait.

    Args:
        grips: where the grippers hold, high above the table.
        swing: m, to either side of the start.
        heading: rad, forward direction, from the world's x axis.
        landing: m, the grip's height where it opens.
        pull: m, horizontal displacement while going down, against the heading.
        rest: s, time after opening.
        limits: of the grippers.

    Raises:
        InvalidInput: a value that defines no motion, or a path through the table.
    """
    check_positive(swing=swing, landing=landing)
    check_finite(pull=pull)
    drop = landing - min_grip_height(grips)
    check_positive(**{"grips' height over the landing": -drop})
    shifts = [
        horizontal_shift(heading, -swing),
        horizontal_shift(heading, 2 * swing),
        horizontal_shift(heading, -pull, drop),
    ]
    moves = [Move(shift) for shift in shifts]
    return build_action(grips, moves, heading, rest, limits)
