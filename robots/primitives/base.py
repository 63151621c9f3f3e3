"""What all motions are made of: straight or arched moves of the grippers, each at rest at both ends.

World: z up, the table's top at z = 0. A move has the least jerk and lasts as long as its limits of speed and
acceleration ask for. Paths only: no robot is asked whether it can; ``robots.plan`` asks one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchcloth.errors import InvalidInput
from torchcloth.types import Trajectory

LONGEST = 3600.0  # s, of a move; slower is no manipulation, and its knots fill the memory
PERIOD = 0.02  # s between knots; the layer interpolates in between
Vector = tuple[float, float, float]
Grips = Mapping[str, Sequence[float]]  # gripper -> [3] m, where it takes hold


class Limits(NamedTuple):
    """How fast a gripper may go. Default: a fling of the public bimanual rigs."""

    speed: float = 1.0  # m/s
    acceleration: float = 5.0  # m/s^2


class Action(NamedTuple):
    """Paths by gripper, and what they are made of."""

    motion: dict[str, Trajectory]
    duration: float  # s
    release: float  # s, when all grippers open; the duration where they never do


class Move(NamedTuple):
    """A piece of path, from u = 0 to 1, where the last move ended; the same for all grippers but for ``apart``."""

    along: Vector = (0.0, 0.0, 0.0)  # m, straight shift
    bow: Vector = (0.0, 0.0, 0.0)  # m, half axis of an ellipse over that shift
    roll: float = 0.0  # rad, about the axis to the heading's left
    apart: float = 0.0  # m, by which the distance of two grippers grows, half at each
    least: float = 0.0  # s, takes at least so long

    @property
    def moves(self) -> bool:
        """Whether anything moves."""
        return any(self.along) or any(self.bow) or bool(self.apart)


def action(
    grips: Grips, moves: Sequence[Move], heading: float, rest: float, limits: Limits, *, release: bool = True
) -> Action:
    """The moves of all grippers, then a rest, before which they open unless they hold on.

    Args:
        grips: where the grippers hold, at the start.
        moves: one after the other; those that go nowhere are left out.
        heading: of the motion, from the world's x axis [rad]; rolls are about the horizontal axis to its left.
        rest: time after the last move [s].
        limits: of the grippers.
        release: whether the grippers open at the end of the last move.

    Raises:
        InvalidInput: a value that gives no motion, or none that ends, or a path through the table.
    """
    check(speed=limits.speed, acceleration=limits.acceleration, rest=rest)
    for move in moves:
        finite(roll=move.roll)
    start = points(grips)
    moves = [move for move in moves if move.moves]
    aside = _aside(start, any(move.apart for move in moves))
    times, shift, roll, apart = _sample(moves, limits)
    end = float(times[-1])
    times = torch.cat([times, times.new_tensor([end + 0.5 * rest, end + rest])])
    shift, roll, apart = (torch.cat([field, field[-1:], field[-1:]]) for field in (shift, roll, apart))
    paths = start[:, None] + shift + aside[:, None] * apart
    if float(paths[..., 2].min()) < 0:
        raise InvalidInput("path", got="a gripper below z = 0", expected="heights above the table")
    turn = _turned(roll, heading)
    closed = times < end - 1e-9 if release else torch.ones_like(times, dtype=torch.bool)
    motion = {}
    for name, path in zip(grips, paths, strict=True):
        pose = torch.eye(4, dtype=torch.float64).repeat(len(times), 1, 1)
        pose[:, :3, :3], pose[:, :3, 3] = turn, path
        motion[name] = Trajectory(times, pose, closed)
    return Action(motion, float(times[-1]), end if release else float(times[-1]))


def minimum_jerk(u: Tensor) -> Tensor:
    """Share of the way at share ``u`` of the time: 10 u^3 - 15 u^4 + 6 u^5, at rest at both ends."""
    return u**3 * (10 + u * (6 * u - 15))


def along(heading: float, distance: float, rise: float = 0.0) -> Vector:
    """A shift [m] by ``distance`` in the direction ``heading`` [rad] from the x axis, and upwards by ``rise``."""
    finite(heading=heading)
    return distance * math.cos(heading), distance * math.sin(heading), rise


def lowest(grips: Grips) -> float:
    """Height of the lowest gripper [m]."""
    return float(points(grips)[:, 2].min())


def rise_to(height: float, grips: Grips) -> float:
    """How far [m] the lowest gripper rises to a height above the table; refuses one that is not above it."""
    start = lowest(grips)
    if not height > start or math.isinf(height):
        raise InvalidInput(
            "height above the table",
            got=f"{height:g} m",
            expected=f"more than the grips' own: the lowest is at {start:g} m",
            remedy="lower the grips, or ask for more height",
        )
    return height - start


def points(grips: Grips) -> Tensor:
    """[G, 3] m, where the grippers hold; refuses what is no place."""
    try:
        start = torch.tensor([list(point) for point in grips.values()], dtype=torch.float64)
    except (AttributeError, TypeError, ValueError):
        start = torch.empty(0)
    if start.ndim != 2 or start.shape[1] != 3 or not bool(start.isfinite().all()):
        raise InvalidInput(
            "grips",
            got=f"{grips}",
            expected='three finite coordinates in metres for each gripper, as {"left": (0.5, 0.2, 0.02)}',
        )
    return start


def check(**values: float) -> None:
    """Refuses values that are not finite and above 0."""
    for name, value in values.items():
        if not (math.isfinite(value) and value > 0):
            raise InvalidInput(name, got=f"{value:g}", expected="a finite value > 0")


def finite(**values: float) -> None:
    """Refuses values that are not finite."""
    for name, value in values.items():
        if not math.isfinite(value):
            raise InvalidInput(name, got=value, expected="a finite number")


def whole(**values: float) -> None:
    """Refuses what is no number of times."""
    for name, value in values.items():
        if not (1 <= value < math.inf and value == int(value)):
            raise InvalidInput(name, got=value, expected="a whole number >= 1")


def _sample(moves: Sequence[Move], limits: Limits) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Times [K] s, shift [K, 3] m, roll [K] rad and growth [K, 1] m of the distance, of one move after the other."""
    zero = torch.zeros(1, dtype=torch.float64)
    times, shifts, rolls, aparts = [zero], [torch.zeros(1, 3, dtype=torch.float64)], [zero], [zero[:, None]]
    for move in moves:
        duration = _least_time(move, limits)
        if duration > LONGEST:
            raise InvalidInput(
                "speed or acceleration",
                got=f"{limits.speed:g} m/s and {limits.acceleration:g} m/s^2, with which a move takes {duration:.3g} s",
                expected=f"at most {LONGEST:g} s",
                remedy="ask for more of them",
            )
        s = _shares(max(4, math.ceil(duration / PERIOD)))
        times.append(times[-1][-1] + duration * torch.linspace(0, 1, len(s), dtype=s.dtype)[1:])
        shifts.append(shifts[-1][-1] + _way(move, s)[1:])
        rolls.append(rolls[-1][-1] + move.roll * s[1:])
        aparts.append(aparts[-1][-1] + move.apart * s[1:, None])
    return torch.cat(times), torch.cat(shifts), torch.cat(rolls), torch.cat(aparts)


def _least_time(move: Move, limits: Limits) -> float:
    """Shortest duration [s] within the limits: 15/8 L / speed or sqrt(10/sqrt(3) L / acceleration) on a straight L."""
    count = 1000
    s = _shares(count)
    way = _way(move, s)
    if move.apart:  # across the shift, or shorter than that
        way = torch.cat([way, 0.5 * move.apart * s[:, None]], dim=-1)
    speed = way.diff(dim=0).norm(dim=-1).max() * count
    acceleration = way.diff(n=2, dim=0).norm(dim=-1).max() * count**2
    return max(float(speed) / limits.speed, math.sqrt(float(acceleration) / limits.acceleration), move.least)


def _way(move: Move, s: Tensor) -> Tensor:
    """Shift [K, 3] m at shares ``s`` [K] of the way."""
    straight, bow = (torch.tensor(vector, dtype=s.dtype) for vector in (move.along, move.bow))
    share = (1 - torch.cos(math.pi * s)) / 2 if any(move.bow) else s
    return share[:, None] * straight + torch.sin(math.pi * s)[:, None] * bow


def _shares(intervals: int) -> Tensor:
    return minimum_jerk(torch.linspace(0, 1, intervals + 1, dtype=torch.float64))


def _turned(roll: Tensor, heading: float) -> Tensor:
    """Rotations [K, 3, 3] about the horizontal axis that carries up into the heading."""
    x, y = -math.sin(heading), math.cos(heading)
    cross = torch.tensor([[0.0, 0.0, y], [0.0, 0.0, -x], [-y, x, 0.0]], dtype=torch.float64)
    angle = roll[:, None, None]
    return torch.eye(3, dtype=torch.float64) + torch.sin(angle) * cross + (1 - torch.cos(angle)) * (cross @ cross)


def _aside(start: Tensor, needed: bool) -> Tensor:
    """[G, 3], half a unit vector from the other gripper to each; zero where no move takes them apart."""
    if not needed:
        return torch.zeros_like(start)
    if len(start) != 2:
        raise InvalidInput("grips", got=f"{len(start)} gripper(s)", expected="two, to be moved apart")
    line = start[0] - start[1]
    if not float(line.norm()) > 0:
        raise InvalidInput("grips", got="two grippers at one place", expected="two places")
    return 0.5 * torch.stack([line, -line]) / line.norm()
