"""Cover: the held part is laid over the rest of the cloth."""

from __future__ import annotations

import math

from .base import Action, GripperLimits, Grips, Move, build_action, check_positive, horizontal_shift, min_grip_height


def cover(
    grips: Grips,
    reach: float,
    *,
    heading: float = -math.pi / 2,
    height: float | None = None,
    landing: float = 0.02,
    roll: float = math.pi,
    rest: float = 0.4,
    limits: GripperLimits = GripperLimits(),  # noqa: B008 - immutable
) -> Action:
    """Lay the held part over the rest: an arch from the grip to a place ``reach`` away, open there, wait.

    Args:
        grips: where the grippers hold, at the start.
        reach: m, horizontal distance from the grip to the landing.
        heading: rad, direction of the landing, from the world's x axis.
        height: m, of the arch above the straight line from grip to landing, in the middle. None: half the reach, a
            semicircle if the landing is as high as the grip.
        landing: m, the grip's height where it opens.
        roll: rad, rotation of the grippers along the path. A roll of pi lays the cloth without a twist at the grip, but
            brings an arm's hand to the table: ``bimanual_rig`` can do about 0.7.
        rest: s, time after opening.
        limits: of the grippers.

    Raises:
        InvalidInput: a value that defines no motion, or a path through the table.
    """
    top = 0.5 * reach if height is None else height
    check_positive(reach=reach, height=top, landing=landing)
    drop = landing - min_grip_height(grips)
    forward = horizontal_shift(heading, reach, drop)
    return build_action(grips, [Move(forward, (0.0, 0.0, top), roll)], heading, rest, limits)
