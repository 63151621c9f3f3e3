"""Hang: cloth is lifted and hangs still."""

from __future__ import annotations

from .base import Action, GripperLimits, Grips, Move, build_action, check_finite, compute_rise, horizontal_shift


def hang(
    grips: Grips,
    height: float = 0.5,
    *,
    heading: float = 0.0,
    carry: float = 0.0,
    rest: float = 1.0,
    limits: GripperLimits = GripperLimits(),  # noqa: B008 - immutable
) -> Action:
    """Lift the held part, carry it along while lifting, and wait until the cloth rests. The grippers never open.

    Args:
        grips: where the grippers hold, at the start.
        height: m, of the lowest gripper above the table at the end.
        heading: rad, direction in which the cloth is carried, from the world's x axis.
        carry: m, how far; negative values go against the heading.
        rest: s, time at the end.
        limits: of the grippers.

    Raises:
        InvalidInput: a value that defines no motion, or a height below the grips.
    """
    rise = compute_rise(height, grips)
    check_finite(carry=carry)
    return build_action(grips, [Move(horizontal_shift(heading, carry, rise))], heading, rest, limits, release=False)
