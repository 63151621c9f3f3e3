"""Drag: cloth is drawn over the table."""

from __future__ import annotations

import math

from .base import Action, Grips, Limits, Move, action, along, check, lowest


def drag(
    grips: Grips,
    distance: float = 0.3,
    *,
    heading: float = math.pi / 2,
    height: float = 0.05,
    landing: float = 0.02,
    rest: float = 0.3,
    limits: Limits = Limits(),  # noqa: B008 - immutable
) -> Action:
    """Lift the held part a little, draw the cloth over the table, put it down, open, wait.

    Args:
        grips: where the grippers hold, at the start.
        distance: that the cloth is drawn [m].
        heading: direction of the pull, from the world's x axis [rad].
        height: of the grip during the pull [m].
        landing: the grip's height where it opens [m].
        rest: time after opening [s].
        limits: of the grippers.

    Raises:
        InvalidInput: a value that gives no motion, or a path through the table.
    """
    check(distance=distance, height=height, landing=landing)
    rise = height - lowest(grips)
    moves = [Move((0.0, 0.0, rise)), Move(along(heading, distance)), Move((0.0, 0.0, landing - height))]
    return action(grips, moves, heading, rest, limits)
