"""Swing: hanging cloth is moved to and fro."""

from __future__ import annotations

from .base import Action, Grips, Limits, Move, action, along, check, whole


def swing(
    grips: Grips,
    amplitude: float = 0.1,
    *,
    cycles: int = 2,
    period: float = 1.4,
    heading: float = 0.0,
    rest: float = 0.3,
    limits: Limits = Limits(),  # noqa: B008 - immutable
) -> Action:
    """Move hanging cloth to and fro about the start, and end there. They never open.

    Args:
        grips: where the grippers hold, at the start.
        amplitude: to either side of the start [m].
        cycles: how often forward and back.
        period: of one cycle, if the limits allow [s].
        heading: of the first side, from the world's x axis [rad].
        rest: time at the end [s].
        limits: of the grippers.

    Raises:
        InvalidInput: a value that gives no motion.
    """
    return to_and_fro(grips, amplitude, along(heading, 1.0), cycles, period, heading, rest, limits)


def to_and_fro(
    grips: Grips,
    amplitude: float,
    direction: tuple[float, float, float],
    cycles: int,
    period: float,
    heading: float,
    rest: float,
    limits: Limits,
) -> Action:
    """Half a way out, whole ways between both ends, half a way home, along a unit vector."""
    check(amplitude=amplitude, period=period)
    whole(cycles=cycles)
    half = period / 2
    ways = [(1, 0.5 * half), *((2 * (-1) ** k, half) for k in range(1, 2 * int(cycles))), (1, 0.5 * half)]
    x, y, z = direction
    moves = [Move((w * amplitude * x, w * amplitude * y, w * amplitude * z), least=least) for w, least in ways]
    return action(grips, moves, heading, rest, limits, release=False)
