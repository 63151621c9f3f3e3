"""Stretch: cloth is pulled taut between two grippers."""

from __future__ import annotations

from .base import Action, Grips, Limits, Move, action, check, whole


def stretch(
    grips: Grips,
    by: float = 0.02,
    *,
    cycles: int = 1,
    hold: float = 0.3,
    rest: float = 0.3,
    limits: Limits = Limits(),  # noqa: B008 - immutable
) -> Action:
    """Move two grippers apart along their line, hold, and go back; as often as asked. They never open.

    Args:
        grips: where the two grippers hold, at the start.
        by: how much their distance grows [m].
        cycles: how often.
        hold: the way out takes so long [s], and the way back, if the limits allow.
        rest: time at the end [s].
        limits: of the grippers.

    Raises:
        InvalidInput: a value that gives no motion, or another number of grippers than two.
    """
    check(by=by, hold=hold)
    whole(cycles=cycles)
    moves = [Move(apart=by, least=hold), Move(apart=-by, least=hold)] * int(cycles)
    return action(grips, moves, 0.0, rest, limits, release=False)
