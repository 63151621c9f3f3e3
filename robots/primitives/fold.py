"""Fold: the held edge is laid onto the other side of a crease."""

from __future__ import annotations

import math

from .base import Action, GripperLimits, Grips, Move, build_action, check_positive, compute_rise, horizontal_shift


def fold(
    grips: Grips,
    crease: float = 0.2,
    *,
    heading: float = -math.pi / 2,
    height: float = 0.12,
    landing: float = 0.03,
    short: float = 0.02,
    roll: float = math.pi,
    rest: float = 0.4,
    limits: GripperLimits = GripperLimits(),  # noqa: B008 - immutable
) -> Action:
    """Lift the held edge, carry it level over the crease, set it down on the cloth's other side, open, wait.

    Args:
        grips: where the grippers hold, at the start.
        crease: m, horizontal distance from the grips to the crease. The grips land as far behind it, less ``short``.
        heading: rad, direction of the crease, from the world's x axis.
        height: m, of the grips above the table while they cross.
        landing: m, the grips' height where they open.
        short: m, by which the edge stays behind its mirror image.
        roll: rad, rotation of the grippers while they cross. A roll of pi lays the edge down without a twist at the
            grip, but brings an arm's hand to the table: ``bimanual_rig`` can do about 0.7.
        rest: s, time after opening.
        limits: of the grippers.

    Raises:
        InvalidInput: a value that defines no motion, or a path through the table.
    """
    reach = 2 * crease - short
    check_positive(crease=crease, reach=reach, landing=landing, **{"height over the landing": height - landing})
    rise = compute_rise(height, grips)
    moves = [
        Move((0.0, 0.0, rise)),
        Move(horizontal_shift(heading, reach), roll=roll),
        Move((0.0, 0.0, landing - height)),
    ]
    return build_action(grips, moves, heading, rest, limits)
