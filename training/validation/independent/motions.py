"""Commanded gripper paths: minimum-jerk legs between waypoints, in plain numpy.

All are laid out about the sheet's own axes, x forward, y to the left, and turned about the vertical by ``heading``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from torchcloth.errors import InvalidInput

from .flex_sheet import SheetSpec

Array = np.ndarray
KNOT = 0.01  # s
STILL = 0.2  # s, all stand still before and after
PIVOT = np.array([0.5, 0.0, 0.0])  # m, about which a heading turns the scene
TAUT = 1.006  # distance of the grippers over the width; a slack edge snaps through, and no two engines then agree


@dataclass(frozen=True)
class Motion:
    """A commanded motion.

    Attributes:
        t: [K] s.
        pose: gripper -> [K, 4, 4] m.
        held: gripper -> [2] m, the pattern point that it holds.
        start: [V, 3] m, from pattern coordinates [V, 2]: a place to settle from.
        table: a table lies under the sheet.
    """

    t: Array
    pose: dict[str, Array]
    held: dict[str, Array]
    start: Callable[[Array], Array]
    table: bool = False


@dataclass(frozen=True)
class _Plan:
    """Waypoints: time s of each, offsets [N, 3] m common to both grippers, distance apart and yaw of each waypoint."""

    t: list[float]
    offset: list[tuple[float, float, float]]
    apart: list[float] = field(default_factory=list)
    yaw: list[float] = field(default_factory=list)


def minimum_jerk(t: Array, knots: Array, values: Array) -> Array:
    """Values [K, ...] at times [K] s on the way between ``values`` [N, ...] at ``knots`` [N] s, at rest at each."""
    leg = np.clip(np.searchsorted(knots, t, side="right") - 1, 0, len(knots) - 2)
    s = np.clip((t - knots[leg]) / (knots[leg + 1] - knots[leg]), 0, 1)
    s = (s**3 * (10 - 15 * s + 6 * s * s)).reshape(-1, *[1] * (values.ndim - 1))
    return (1 - s) * values[leg] + s * values[leg + 1]


def _back_and_forth(amplitude: float, leg: float, cycles: int, axis: int) -> _Plan:
    """Between +- amplitude m along an axis, ``leg`` s from end to end."""
    offsets, times = [np.zeros(3)], [0.0]
    for k in range(2 * cycles):
        offsets.append(np.eye(3)[axis] * amplitude * (-1) ** k)
        times.append(times[-1] + (leg if k else 0.6 * leg))
    offsets.append(np.zeros(3))
    times.append(times[-1] + 0.6 * leg)
    return _Plan(times, [tuple(o) for o in offsets])


HANGING = {
    "hang": _Plan([0.0, 1.0], [(0, 0, 0), (0, 0, 0)]),
    "drape": _Plan([0.0, 1.0], [(0, 0, 0), (0, 0, 0)], apart=[-0.010, -0.010]),
    "swing": _back_and_forth(0.05, 0.85, 1, 0),
    "swing-fast": _back_and_forth(0.04, 0.34, 1, 0),
    "shake": _back_and_forth(0.02, 0.22, 3, 2),
    "stretch": _Plan([0.0, 0.5, 0.8, 1.3], [(0, 0, 0)] * 4, apart=[0.0, 0.010, 0.010, 0.0]),
    "turn": _Plan(
        [0.0, 1.0, 1.3, 2.3], [(0, 0, 0), (0.04, 0, 0), (0.04, 0, 0), (0, 0, 0)], yaw=[0.0, np.pi / 2, np.pi / 2, 0.0]
    ),
}
# from a sheet that lies on the table, upper edge held: the path of that edge, and how far apart the grippers go
LYING = {
    "drag": _Plan([0.0, 0.25, 1.25], [(0, 0, 0), (0, 0, 0.02), (0.16, 0, 0.02)]),
    "drag-fast": _Plan([0.0, 0.25, 0.70], [(0, 0, 0), (0, 0, 0.02), (0.16, 0, 0.02)]),
    "lift": _Plan([0.0, 1.4], [(0, 0, 0), (-0.12, 0, 0.40)]),
    "fold": _Plan([0.0, 0.7, 1.5], [(0, 0, 0), (-0.12, 0, 0.15), (-0.22, 0, 0.07)]),
    "fold-open": _Plan(
        [0.0, 0.6, 1.1, 1.3, 2.5], [(0, 0, 0), (-0.12, 0, 0.15), (-0.22, 0, 0.07), (-0.22, 0, 0.07), (-0.15, 0, 0.36)]
    ),
}
NAMES = (*HANGING, *LYING)
GRIPPERS = {"left": 1.0, "right": -1.0}  # side along y


def motion(
    name: str, sheet: SheetSpec, heading: float = 0.0, speed: float = 1.0, start: tuple[float, float] = (0.0, 0.0)
) -> Motion:
    """A motion by name.

    Args:
        name: one of ``NAMES``.
        sheet: its corners are held.
        heading: degrees about the vertical.
        speed: 2 takes half the time.
        start: m, x and y by which all of it lies beside the usual place.

    Raises:
        InvalidInput: no such motion, or a speed that is not positive.
    """
    if name not in NAMES:
        raise InvalidInput("motion", got=repr(name), expected=f"one of {', '.join(NAMES)}")
    if not speed > 0:
        raise InvalidInput("speed", got=speed, expected="a value > 0")
    lying = name in LYING
    plan = (LYING if lying else HANGING)[name]
    home = np.array([sheet.height / 2, 0.0, 0.0] if lying else [0.0, 0.0, 0.10 + sheet.height])
    knots = STILL + np.asarray(plan.t) / speed
    t = np.arange(round((knots[-1] + STILL) / KNOT) + 1) * KNOT
    offset = minimum_jerk(t, knots, np.asarray(plan.offset, float))
    apart = (1.0 if lying else TAUT) * sheet.width + _along(t, knots, plan.apart)
    yaw = np.deg2rad(heading) + _along(t, knots, plan.yaw)
    turn = _about_z(np.full_like(t, np.deg2rad(heading)))
    centre = PIVOT + np.array([*start, 0.0]) + np.einsum("kab,kb->ka", turn, home + offset)
    pose, held = {}, {}
    for gripper, side in GRIPPERS.items():
        pose[gripper] = np.tile(np.eye(4), (len(t), 1, 1))
        pose[gripper][:, :3, :3] = _about_z(yaw)
        pose[gripper][:, :3, 3] = centre + np.einsum("kab,kb->ka", _about_z(yaw), _sideways(side * apart / 2))
        held[gripper] = np.array([0.0 if side > 0 else sheet.width, sheet.height])
    return Motion(t, pose, held, _start(sheet, centre[0], np.deg2rad(heading), apart[0], lying), lying)


def _start(sheet: SheetSpec, edge: Array, yaw: float, apart: float, lying: bool) -> Callable[[Array], Array]:
    """The flat sheet with its upper edge at the grippers: hanging with a bulge, or lying behind them."""

    def place(uv: Array) -> Array:
        a, b = uv[:, 0] / sheet.width, uv[:, 1] / sheet.height
        y, below = apart / 2 * (1 - 2 * a), uv[:, 1] - sheet.height
        bulge = 2e-3 * (np.sin(np.pi * a) + 0.3 * np.sin(2 * np.pi * a)) * (1 - b)  # a plane is a bifurcation
        x = below if lying else bulge
        local = np.stack([x, y, 0 * y if lying else below], 1)
        return edge + local @ _about_z(np.array([yaw]))[0].T

    return place


def _along(t: Array, knots: Array, values: list[float]) -> Array:
    return minimum_jerk(t, knots, np.asarray(values, float)) if values else np.zeros(len(t))


def _sideways(y: Array) -> Array:
    return np.stack([0 * y, y, 0 * y], 1)


def _about_z(angle: Array) -> Array:
    c, s, o = np.cos(angle), np.sin(angle), 0 * angle
    return np.stack([c, -s, o, s, c, o, o, o, o + 1], 1).reshape(-1, 3, 3)
