"""Fold: the held edge is laid onto the other side of a crease."""

from __future__ import annotations

import math

from .base import Action, Grips, Limits, Move, action, along, check, rise_to


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
    limits: Limits = Limits(),  # noqa: B008 - immutable
) -> Action:
    """Lift the held edge, carry it level over the crease, set it down on the cloth's other side, open, wait.

    Args:
        grips: where the grippers hold, at the start.
        crease: horizontal distance from the grips to the crease [m]; they land as far behind it, less ``short``.
        heading: direction of the crease, from the world's x axis [rad].
        height: of the grips above the table while they cross [m].
        landing: the grips' height where they open [m].
        short: how far the edge stays behind its mirror image [m].
        roll: turn of the grippers while they cross [rad]; pi lays the edge down without a twist at the grip, but
            brings an arm's hand to the table: ``bimanual_rig`` can do about 0.7.
        rest: time after opening [s].
        limits: of the grippers.

    Raises:
        InvalidInput: a value that gives no motion, or a path through the table.
    """
    reach = 2 * crease - short
    check(crease=crease, reach=reach, landing=landing, **{"height over the landing": height - landing})
    rise = rise_to(height, grips)
    moves = [
        Move((0.0, 0.0, rise)),
        Move(along(heading, reach), roll=roll),
        Move((0.0, 0.0, landing - height)),
    ]
    return action(grips, moves, heading, rest, limits)
