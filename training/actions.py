"""What the robot does with a garment that it holds at two places: cover, fling and drag, as paths of the grippers.

World: z up, the table's top at z = 0. Between way points the grippers move with the least jerk and stand still at each;
a move lasts as long as its limits of speed and acceleration ask for. Paths only: no robot is asked whether it can.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchcloth.errors import InvalidInput
from torchcloth.types import Trajectory

PERIOD = 0.02  # s between knots; the layer interpolates in between
Grips = dict[str, Sequence[float]]  # gripper -> [3] m, where it takes hold


class Limits(NamedTuple):
    """How fast a gripper may go. Default: a fling of the public bimanual rigs."""

    speed: float = 1.0  # m/s
    acceleration: float = 5.0  # m/s^2


class Action(NamedTuple):
    """Paths by gripper, and what they are made of."""

    motion: dict[str, Trajectory]
    duration: float  # s
    release: float  # s, when both grippers open


class _Move(NamedTuple):
    """A piece of path, the same for both grippers: from u = 0 to 1, where the last move ended."""

    along: tuple[float, float, float]  # m, straight shift
    bow: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m, half axis of an ellipse over that shift
    roll: float = 0.0  # rad, about the axis to the heading's right


def cover(
    grips: Grips,
    reach: float,
    *,
    heading: float = -math.pi / 2,
    height: float | None = None,
    landing: float = 0.02,
    roll: float = math.pi,
    rest: float = 0.4,
    limits: Limits = Limits(),  # noqa: B008 - immutable
) -> Action:
    """Lay the held part over the rest: an arch from the grip to a place ``reach`` away, open there, wait.

    Args:
        grips: where the grippers hold, at the start.
        reach: horizontal distance from the grip to the landing [m].
        heading: direction of the landing, from the world's x axis [rad].
        height: of the arch's top above the grip [m]; None: half the reach, a semicircle.
        landing: the grip's height where it opens [m].
        roll: turn of the grippers on the way [rad]; pi lays the cloth without a twist at the grip.
        rest: time after opening [s].
        limits: of the grippers.

    Raises:
        InvalidInput: a value that gives no motion, or a path through the table.
    """
    top = 0.5 * reach if height is None else height
    _check(reach=reach, height=top, landing=landing)
    drop = landing - _lowest(grips)
    forward = _along(heading, reach, drop)
    return _action(grips, [_Move(forward, (0.0, 0.0, top), roll)], heading, rest, limits)


def fling(
    grips: Grips,
    swing: float = 0.3,
    *,
    heading: float = -math.pi / 2,
    landing: float = 0.03,
    pull: float = 0.3,
    rest: float = 0.4,
    limits: Limits = Limits(),  # noqa: B008 - immutable
) -> Action:
    """Swing hanging cloth back and forward, lay it down while drawing back, open, wait.

    Args:
        grips: where the grippers hold, high above the table.
        swing: to either side of the start [m].
        heading: forward, from the world's x axis [rad].
        landing: the grip's height where it opens [m].
        pull: horizontal way while going down, against the heading [m].
        rest: time after opening [s].
        limits: of the grippers.

    Raises:
        InvalidInput: a value that gives no motion, or a path through the table.
    """
    _check(swing=swing, landing=landing)
    drop = landing - _lowest(grips)
    _check(**{"grips' height over the landing": -drop})
    shifts = [_along(heading, -swing), _along(heading, 2 * swing), _along(heading, -pull, drop)]
    moves = [_Move(shift) for shift in shifts]
    return _action(grips, moves, heading, rest, limits)


def drag(
    grips: Grips,
    distance: float = 0.3,
    *,
    heading: float = math.pi / 2,
    height: float = 0.05,
    landing: float = 0.02,
    rest: float = 0.3,
    limits: Limits = Limits(),  # noqa: B008 - immutable
) -> Action:
    """Lift the held part a little, draw the cloth over the table, put it down, open, wait.

    Args:
        grips: where the grippers hold, at the start.
        distance: that the cloth is drawn [m].
        heading: direction of the pull, from the world's x axis [rad].
        height: of the grip during the pull [m].
        landing: the grip's height where it opens [m].
        rest: time after opening [s].
        limits: of the grippers.

    Raises:
        InvalidInput: a value that gives no motion, or a path through the table.
    """
    _check(distance=distance, height=height, landing=landing)
    rise = height - _lowest(grips)
    moves = [_Move((0.0, 0.0, rise)), _Move(_along(heading, distance)), _Move((0.0, 0.0, landing - height))]
    return _action(grips, moves, heading, rest, limits)


def minimum_jerk(u: Tensor) -> Tensor:
    """Share of the way at share ``u`` of the time: 10 u^3 - 15 u^4 + 6 u^5, at rest at both ends."""
    return u**3 * (10 + u * (6 * u - 15))


def _action(grips: Grips, moves: list[_Move], heading: float, rest: float, limits: Limits) -> Action:
    _check(speed=limits.speed, acceleration=limits.acceleration, rest=rest)
    start = _points(grips)
    times, shift, roll = _sample([m for m in moves if any(m.along)], limits)
    release = float(times[-1])
    times = torch.cat([times, times.new_tensor([release + 0.5 * rest, release + rest])])
    shift, roll = (torch.cat([field, field[-1:], field[-1:]]) for field in (shift, roll))
    if float((start[:, None] + shift)[..., 2].min()) < 0:
        raise InvalidInput("path", got="a gripper below z = 0", expected="heights above the table")
    turn = _turned(roll, heading)
    closed = times < release - 1e-9
    motion = {}
    for name, origin in zip(grips, start, strict=True):
        pose = torch.eye(4, dtype=torch.float64).repeat(len(times), 1, 1)
        pose[:, :3, :3], pose[:, :3, 3] = turn, origin + shift
        motion[name] = Trajectory(times, pose, closed)
    return Action(motion, float(times[-1]), release)


def _sample(moves: list[_Move], limits: Limits) -> tuple[Tensor, Tensor, Tensor]:
    """Times [K] s, shift [K, 3] m and roll [K] rad of the moves, one after the other."""
    zero = torch.zeros(1, dtype=torch.float64)
    times, shifts, rolls = [zero], [torch.zeros(1, 3, dtype=torch.float64)], [zero]
    for move in moves:
        duration = _least_time(move, limits)
        s = _shares(max(4, math.ceil(duration / PERIOD)))
        times.append(times[-1][-1] + duration * torch.linspace(0, 1, len(s), dtype=s.dtype)[1:])
        shifts.append(shifts[-1][-1] + _way(move, s)[1:])
        rolls.append(rolls[-1][-1] + move.roll * s[1:])
    return torch.cat(times), torch.cat(shifts), torch.cat(rolls)


def _least_time(move: _Move, limits: Limits) -> float:
    """Shortest duration [s] within the limits: 15/8 L / speed or sqrt(10/sqrt(3) L / acceleration) on a straight L."""
    count = 1000
    way = _way(move, _shares(count))
    speed = way.diff(dim=0).norm(dim=-1).max() * count
    acceleration = way.diff(n=2, dim=0).norm(dim=-1).max() * count**2
    return max(float(speed) / limits.speed, math.sqrt(float(acceleration) / limits.acceleration))


def _way(move: _Move, s: Tensor) -> Tensor:
    """Shift [K, 3] m at shares ``s`` [K] of the way."""
    along, bow = (torch.tensor(vector, dtype=s.dtype) for vector in (move.along, move.bow))
    share = (1 - torch.cos(math.pi * s)) / 2 if any(move.bow) else s
    return share[:, None] * along + torch.sin(math.pi * s)[:, None] * bow


def _shares(intervals: int) -> Tensor:
    return minimum_jerk(torch.linspace(0, 1, intervals + 1, dtype=torch.float64))


def _turned(roll: Tensor, heading: float) -> Tensor:
    """Rotations [K, 3, 3] about the horizontal axis that carries up into the heading."""
    x, y = -math.sin(heading), math.cos(heading)
    cross = torch.tensor([[0.0, 0.0, y], [0.0, 0.0, -x], [-y, x, 0.0]], dtype=torch.float64)
    angle = roll[:, None, None]
    return torch.eye(3, dtype=torch.float64) + torch.sin(angle) * cross + (1 - torch.cos(angle)) * (cross @ cross)


def _along(heading: float, distance: float, rise: float = 0.0) -> tuple[float, float, float]:
    if not math.isfinite(heading):
        raise InvalidInput("heading", got=heading, expected="a finite angle in radians")
    return distance * math.cos(heading), distance * math.sin(heading), rise


def _lowest(grips: Grips) -> float:
    return float(_points(grips)[:, 2].min())


def _points(grips: Grips) -> Tensor:
    if not grips or any(len(point) != 3 or not all(map(math.isfinite, point)) for point in grips.values()):
        raise InvalidInput(
            "grips", got=f"{dict(grips)}", expected="three finite coordinates in metres for each gripper"
        )
    return torch.tensor(list(grips.values()), dtype=torch.float64)


def _check(**values: float) -> None:
    for name, value in values.items():
        if not (math.isfinite(value) and value > 0):
            raise InvalidInput(name, got=f"{value:g}", expected="a finite value > 0")
