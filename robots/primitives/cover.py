"""Cover: the held part is laid over the rest."""

from __future__ import annotations

import math

from .base import Action, Grips, Limits, Move, action, along, check, lowest


def cover(
    grips: Grips,
    reach: float,
    *,
    heading: float = -math.pi / 2,
    height: float | None = None,
    landing: float = 0.02,
    roll: float = math.pi,
    rest: float = 0.4,
    limits: Limits = Limits(),  # noqa: B008 - immutable
) -> Action:
    """Lay the held part over the rest: an arch from the grip to a place ``reach`` away, open there, wait.

    Args:
        grips: where the grippers hold, at the start.
        reach: horizontal distance from the grip to the landing [m].
        heading: direction of the landing, from the world's x axis [rad].
        height: of the arch over the straight way from grip to landing, in the middle [m]; None: half the reach, a
            semicircle where the landing is as high as the grip.
        landing: the grip's height where it opens [m].
        roll: turn of the grippers on the way [rad]; pi lays the cloth without a twist at the grip, but brings an
            arm's hand to the table: ``bimanual_rig`` can do about 0.7.
        rest: time after opening [s].
        limits: of the grippers.

    Raises:
        InvalidInput: a value that gives no motion, or a path through the table.
    """
    top = 0.5 * reach if height is None else height
    check(reach=reach, height=top, landing=landing)
    drop = landing - lowest(grips)
    forward = along(heading, reach, drop)
    return action(grips, [Move(forward, (0.0, 0.0, top), roll)], heading, rest, limits)
