"""Drag: cloth is drawn over the table."""

from __future__ import annotations

import math

from .base import Action, GripperLimits, Grips, Move, build_action, check_positive, horizontal_shift, min_grip_height


def drag(
    grips: Grips,
    distance: float = 0.3,
    *,
    heading: float = math.pi / 2,
    height: float = 0.05,
    landing: float = 0.02,
    rest: float = 0.3,
    limits: GripperLimits = GripperLimits(),  # noqa: B008 - immutable
) -> Action:
    """Lift the held part a little, draw the cloth over the table, put it down, open, wait.

    Args:
        grips: where the grippers hold, at the start.
        distance: m, by which the cloth is drawn.
        heading: rad, direction of the pull, from the world's x axis.
        height: m, of the grip during the pull.
        landing: m, the grip's height where it opens.
        rest: s, time after opening.
        limits: of the grippers.

    Raises:
        InvalidInput: a value that defines no motion, or a path through the table.
    """
    check_positive(distance=distance, height=height, landing=landing)
    rise = height - min_grip_height(grips)
    moves = [Move((0.0, 0.0, rise)), Move(horizontal_shift(heading, distance)), Move((0.0, 0.0, landing - height))]
    return build_action(grips, moves, heading, rest, limits)
