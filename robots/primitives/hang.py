"""Hang: cloth is lifted and left to hang."""

from __future__ import annotations

from .base import Action, Grips, Limits, Move, action, along, finite, rise_to


def hang(
    grips: Grips,
    height: float = 0.5,
    *,
    heading: float = 0.0,
    carry: float = 0.0,
    rest: float = 1.0,
    limits: Limits = Limits(),  # noqa: B008 - immutable
) -> Action:
    """Lift the held part, carry it along while lifting, and wait for the cloth to come to rest. They never open.

    Args:
        grips: where the grippers hold, at the start.
        height: of the lowest gripper above the table at the end [m].
        heading: direction in which the cloth is carried, from the world's x axis [rad].
        carry: how far [m]; negative goes against the heading.
        rest: time at the end [s].
        limits: of the grippers.

    Raises:
        InvalidInput: a value that gives no motion, or a height below the grips.
    """
    rise = rise_to(height, grips)
    finite(carry=carry)
    return action(grips, [Move(along(heading, carry, rise))], heading, rest, limits, release=False)
