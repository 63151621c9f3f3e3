"""Commanded gripper motions: minimum-jerk legs between waypoints, in plain numpy.

They are laid out about the sheet's own axes, x forward and y to the left, and turned about the vertical by a heading.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from torchcloth.errors import InvalidInput

from .flex_sheet import SheetSpec

Array = np.ndarray
KNOT_PERIOD_S = 0.01
STANDSTILL_S = 0.2  # before and after the motion
PIVOT_M = np.array([0.5, 0.0, 0.0])  # a heading turns the scene about it
# Distance of the grippers over the sheet's width. A slack edge snaps through, and then no two engines agree.
TAUT_DISTANCE_RATIO = 1.006
CLEARANCE_M = 0.10  # of the lower edge of a hanging sheet above z = 0


@dataclass(frozen=True)
class Motion:
    """A commanded motion.

    Attributes:
        t: [K] s.
        pose: [K, 4, 4] m by gripper.
        grasp_points: [2] m by gripper, the pattern point that it holds.
        initial_shape: maps pattern coordinates [V, 2] m to positions [V, 3] m from which the cloth settles.
        on_table: a table lies under the sheet.
    """

    t: Array
    pose: dict[str, Array]
    grasp_points: dict[str, Array]
    initial_shape: Callable[[Array], Array]
    on_table: bool = False


@dataclass(frozen=True)
class _Waypoints:
    """Waypoints of both grippers.

    Attributes:
        t: [N] s.
        offset: [N, 3] m, of both grippers.
        distance: [N] m, added to the distance of the grippers; empty: none.
        yaw: [N] rad; empty: none.
    """

    t: list[float]
    offset: list[tuple[float, float, float]]
    distance: list[float] = field(default_factory=list)
    yaw: list[float] = field(default_factory=list)


def minimum_jerk(t: Array, knots: Array, values: Array) -> Array:
    """Interpolate ``values`` [N, ...] at ``knots`` [N] s by minimum-jerk legs that come to rest at each knot.

    Returns:
        The values [K, ...] at times t [K] s.
    """
    leg = np.clip(np.searchsorted(knots, t, side="right") - 1, 0, len(knots) - 2)
    s = np.clip((t - knots[leg]) / (knots[leg + 1] - knots[leg]), 0, 1)
    s = (s**3 * (10 - 15 * s + 6 * s * s)).reshape(-1, *[1] * (values.ndim - 1))
    return (1 - s) * values[leg] + s * values[leg + 1]


def _oscillation(amplitude: float, leg_seconds: float, cycles: int, axis: int) -> _Waypoints:
    """Return waypoints that go back and forth along an axis, between +- amplitude [m]."""
    offsets, times = [np.zeros(3)], [0.0]
    for k in range(2 * cycles):
        offsets.append(np.eye(3)[axis] * amplitude * (-1) ** k)
        times.append(times[-1] + (leg_seconds if k else 0.6 * leg_seconds))
    offsets.append(np.zeros(3))
    times.append(times[-1] + 0.6 * leg_seconds)
    return _Waypoints(times, [(float(x), float(y), float(z)) for x, y, z in offsets])


HANGING_MOTIONS = {
    "hang": _Waypoints([0.0, 1.0], [(0, 0, 0), (0, 0, 0)]),
    "drape": _Waypoints([0.0, 1.0], [(0, 0, 0), (0, 0, 0)], distance=[-0.010, -0.010]),
    "swing": _oscillation(0.05, 0.85, 1, 0),
    "swing-fast": _oscillation(0.04, 0.34, 1, 0),
    "shake": _oscillation(0.02, 0.22, 3, 2),
    "stretch": _Waypoints([0.0, 0.5, 0.8, 1.3], [(0, 0, 0)] * 4, distance=[0.0, 0.010, 0.010, 0.0]),
    "turn": _Waypoints(
        [0.0, 1.0, 1.3, 2.3], [(0, 0, 0), (0.04, 0, 0), (0.04, 0, 0), (0, 0, 0)], yaw=[0.0, np.pi / 2, np.pi / 2, 0.0]
    ),
}
# The sheet lies on the table and its upper edge is held: the path of that edge.
TABLE_MOTIONS = {
    "drag": _Waypoints([0.0, 0.25, 1.25], [(0, 0, 0), (0, 0, 0.02), (0.16, 0, 0.02)]),
    "drag-fast": _Waypoints([0.0, 0.25, 0.70], [(0, 0, 0), (0, 0, 0.02), (0.16, 0, 0.02)]),
    "lift": _Waypoints([0.0, 1.4], [(0, 0, 0), (-0.12, 0, 0.40)]),
    "fold": _Waypoints([0.0, 0.7, 1.5], [(0, 0, 0), (-0.12, 0, 0.15), (-0.22, 0, 0.07)]),
    "fold-open": _Waypoints(
        [0.0, 0.6, 1.1, 1.3, 2.5], [(0, 0, 0), (-0.12, 0, 0.15), (-0.22, 0, 0.07), (-0.22, 0, 0.07), (-0.15, 0, 0.36)]
    ),
}
MOTION_NAMES = (*HANGING_MOTIONS, *TABLE_MOTIONS)
GRIPPER_SIDES = {"left": 1.0, "right": -1.0}  # sign of y


def make_motion(
    name: str, sheet: SheetSpec, heading: float = 0.0, speed: float = 1.0, start: tuple[float, float] = (0.0, 0.0)
) -> Motion:
    """Return a motion by name.

    Args:
        name: one of ``MOTION_NAMES``.
        sheet: its upper corners are held.
        heading: degrees about the vertical.
        speed: factor; 2 takes half the time.
        start: m, x and y by which the whole motion is displaced.

    Raises:
        InvalidInput: no such motion, or a speed that is not positive.
    """
    if name not in MOTION_NAMES:
        raise InvalidInput("motion", got=repr(name), expected=f"one of {', '.join(MOTION_NAMES)}")
    if not speed > 0:
        raise InvalidInput("speed", got=speed, expected="a value > 0")
    on_table = name in TABLE_MOTIONS
    waypoints = (TABLE_MOTIONS if on_table else HANGING_MOTIONS)[name]
    home = np.array([sheet.height / 2, 0.0, 0.0] if on_table else [0.0, 0.0, CLEARANCE_M + sheet.height])
    knots = STANDSTILL_S + np.asarray(waypoints.t) / speed
    t = np.arange(round((knots[-1] + STANDSTILL_S) / KNOT_PERIOD_S) + 1) * KNOT_PERIOD_S
    offset = minimum_jerk(t, knots, np.asarray(waypoints.offset, float))
    distance = (1.0 if on_table else TAUT_DISTANCE_RATIO) * sheet.width + _interpolate(t, knots, waypoints.distance)
    yaw = np.deg2rad(heading) + _interpolate(t, knots, waypoints.yaw)
    turn = rotations_about_z(np.full_like(t, np.deg2rad(heading)))
    centre = PIVOT_M + np.array([*start, 0.0]) + np.einsum("kab,kb->ka", turn, home + offset)
    pose, grasp_points = {}, {}
    for gripper, side in GRIPPER_SIDES.items():
        sideways = np.stack([0 * distance, side * distance / 2, 0 * distance], 1)
        pose[gripper] = np.tile(np.eye(4), (len(t), 1, 1))
        pose[gripper][:, :3, :3] = rotations_about_z(yaw)
        pose[gripper][:, :3, 3] = centre + np.einsum("kab,kb->ka", rotations_about_z(yaw), sideways)
        grasp_points[gripper] = np.array([0.0 if side > 0 else sheet.width, sheet.height])
    shape = _initial_shape(sheet, centre[0], np.deg2rad(heading), distance[0], on_table)
    return Motion(t, pose, grasp_points, shape, on_table)


def _initial_shape(
    sheet: SheetSpec, edge: Array, yaw: float, distance: float, on_table: bool
) -> Callable[[Array], Array]:
    """Return a flat sheet with its upper edge at the grippers: hanging with a bulge, or lying behind them."""

    def place(uv: Array) -> Array:
        a, b = uv[:, 0] / sheet.width, uv[:, 1] / sheet.height
        y, below = distance / 2 * (1 - 2 * a), uv[:, 1] - sheet.height
        bulge = 2e-3 * (np.sin(np.pi * a) + 0.3 * np.sin(2 * np.pi * a)) * (1 - b)  # a plane is a bifurcation
        x = below if on_table else bulge
        local = np.stack([x, y, 0 * y if on_table else below], 1)
        return edge + local @ rotations_about_z(np.array([yaw]))[0].T

    return place


def _interpolate(t: Array, knots: Array, values: list[float]) -> Array:
    return minimum_jerk(t, knots, np.asarray(values, float)) if values else np.zeros(len(t))


def rotations_about_z(angle: Array) -> Array:
    """Return the rotation matrices [K, 3, 3] of angles [K] rad about the vertical."""
    c, s, o = np.cos(angle), np.sin(angle), 0 * angle
    return np.stack([c, -s, o, s, c, o, o, o, o + 1], 1).reshape(-1, 3, 3)
