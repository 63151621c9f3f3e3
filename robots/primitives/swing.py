"""Swing: hanging cloth is moved to and fro."""

from __future__ import annotations

from .base import Action, GripperLimits, Grips, Move, build_action, check_positive, check_whole, horizontal_shift


def swing(
    grips: Grips,
    amplitude: float = 0.1,
    *,
    cycles: int = 2,
    period: float = 1.4,
    heading: float = 0.0,
    rest: float = 0.3,
    limits: GripperLimits = GripperLimits(),  # noqa: B008 - immutable
) -> Action:
    """Move hanging cloth to and fro about the start, and end there. The grippers never open.

    Args:
        grips: where the grippers hold, at the start.
        amplitude: m, to either side of the start.
        cycles: number of cycles.
        period: s, of one cycle, if the limits allow it.
        heading: rad, direction of the first half cycle, from the world's x axis.
        rest: s, time at the end.
        limits: of the grippers.

    Raises:
        InvalidInput: a value that defines no motion.
    """
    return build_oscillation(grips, amplitude, horizontal_shift(heading, 1.0), cycles, period, heading, rest, limits)


def build_oscillation(
    grips: Grips,
    amplitude: float,
    direction: tuple[float, float, float],
    cycles: int,
    period: float,
    heading: float,
    rest: float,
    limits: GripperLimits,
) -> Action:
    """Build half a swing out, full swings between both ends, and half a swing back, along a unit vector.

    Args:
        grips: where the grippers hold, at the start.
        amplitude: m, to either side of the start.
        direction: unit vector of the first half swing.
        cycles: number of cycles.
        period: s, of one cycle, if the limits allow it.
        heading: rad, of the motion, from the world's x axis.
        rest: s, time at the end.
        limits: of the grippers.
    """
    check_positive(amplitude=amplitude, period=period)
    check_whole(cycles=cycles)
    half = period / 2
    swings = [(1, 0.5 * half), *((2 * (-1) ** k, half) for k in range(1, 2 * int(cycles))), (1, 0.5 * half)]
    x, y, z = direction
    moves = [
        Move((w * amplitude * x, w * amplitude * y, w * amplitude * z), min_duration=duration) for w, duration in swings
    ]
    return build_action(grips, moves, heading, rest, limits, release=False)
