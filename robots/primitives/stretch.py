"""Stretch: cloth is pulled taut between two grippers."""

from __future__ import annotations

from .base import Action, GripperLimits, Grips, Move, build_action, check_positive, check_whole


def stretch(
    grips: Grips,
    by: float = 0.02,
    *,
    cycles: int = 1,
    hold: float = 0.3,
    rest: float = 0.3,
    limits: GripperLimits = GripperLimits(),  # noqa: B008 - immutable
) -> Action:
    """Move two grippers apart along their line, wait, and move back, repeatedly. The grippers never open.

    Args:
        grips: where the two grippers hold, at the start.
        by: m, increase of their distance.
        cycles: number of cycles.
        hold: s, duration of the move outwards and of the move back, if the limits allow it.
        rest: s, time at the end.
        limits: of the grippers.

    Raises:
        InvalidInput: a value that defines no motion, or another number of grippers than two.
    """
    check_positive(by=by, hold=hold)
    check_whole(cycles=cycles)
    moves = [Move(separation=by, min_duration=hold), Move(separation=-by, min_duration=hold)] * int(cycles)
    return build_action(grips, moves, 0.0, rest, limits, release=False)
