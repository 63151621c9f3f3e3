"""The moves that all motions consist of: straight or arched paths of the grippers, at rest at both ends.

World: z up, the table's top at z = 0. A move has the least jerk. It lasts as long as its limits of speed and
acceleration require. These are paths only; ``robots.plan`` checks whether a robot can follow them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchcloth.errors import InvalidInput
from torchcloth.types import Trajectory

from ..trajectories import minimum_jerk

MAX_MOVE_DURATION_S = 3600.0  # a slower move is no manipulation, and its knots would fill the memory
PATH_KNOT_PERIOD_S = 0.02  # time between knots; the layer interpolates between them
MIN_MOVE_KNOT_INTERVALS = 4
DURATION_SAMPLES = 1000  # intervals in which speed and acceleration of a move are measured
Vector = tuple[float, float, float]
Grips = Mapping[str, Sequence[float]]  # [3] m by gripper, where it takes hold


class GripperLimits(NamedTuple):
    """Largest speed and acceleration of a gripper. The defaults are those of a fling of the public bimanual rigs.

    Attributes:
        speed: m/s.
        acceleration: m/s^2.
    """

    speed: float = 1.0
    acceleration: float = 5.0


class Action(NamedTuple):
    """A motion of all grippers.

    Attributes:
        motion: paths by gripper.
        duration: s.
        release_time: s, when all grippers open; the duration if they never do.
    """

    motion: dict[str, Trajectory]
    duration: float
    release_time: float


class Move(NamedTuple):
    """A piece of path that starts where the last move ended, the same for all grippers but for ``separation``.

    Attributes:
        shift: m, straight displacement.
        bow: m, half axis of an ellipse over that displacement.
        roll: rad, about the horizontal axis to the left of the heading.
        separation: m, by which the distance of two grippers grows, half at each.
        min_duration: s.
    """

    shift: Vector = (0.0, 0.0, 0.0)
    bow: Vector = (0.0, 0.0, 0.0)
    roll: float = 0.0
    separation: float = 0.0
    min_duration: float = 0.0

    @property
    def has_motion(self) -> bool:
        """Whether any gripper moves."""
        return any(self.shift) or any(self.bow) or bool(self.separation)


def build_action(
    grips: Grips, moves: Sequence[Move], heading: float, rest: float, limits: GripperLimits, *, release: bool = True
) -> Action:
    """Build the moves of all grippers, then a rest, before which the grippers open if ``release``.

    Args:
        grips: where the grippers hold, at the start.
        moves: one after the other; moves without displacement are left out.
        heading: rad, of the motion, from the world's x axis; rolls are about the horizontal axis to its left.
        rest: s, time after the last move.
        limits: of the grippers.
        release: whether the grippers open at the end of the last move.

    Raises:
        InvalidInput: values that define no motion or an endless one, or a path through the table.
    """
    check_positive(speed=limits.speed, acceleration=limits.acceleration, rest=rest)
    for move in moves:
        check_finite(roll=move.roll)
    start = grip_points(grips)
    moves = [move for move in moves if move.has_motion]
    separation_axis = _separation_axis(start, any(move.separation for move in moves))
    times, shift, roll, apart = _sample(moves, limits)
    end = float(times[-1])
    times = torch.cat([times, times.new_tensor([end + 0.5 * rest, end + rest])])
    shift, roll, apart = (torch.cat([field, field[-1:], field[-1:]]) for field in (shift, roll, apart))
    paths = start[:, None] + shift + separation_axis[:, None] * apart
    if float(paths[..., 2].min()) < 0:
        raise InvalidInput("path", got="a gripper below z = 0", expected="heights above the table")
    turn = _roll_rotations(roll, heading)
    closed = times < end - 1e-9 if release else torch.ones_like(times, dtype=torch.bool)
    motion = {}
    for name, path in zip(grips, paths, strict=True):
        pose = torch.eye(4, dtype=torch.float64).repeat(len(times), 1, 1)
        pose[:, :3, :3], pose[:, :3, 3] = turn, path
        motion[name] = Trajectory(times, pose, closed)
    return Action(motion, float(times[-1]), end if release else float(times[-1]))


def horizontal_shift(heading: float, distance: float, rise: float = 0.0) -> Vector:
    """Return a shift [m] by ``distance`` in the direction ``heading`` [rad] from the x axis, and up by ``rise``."""
    check_finite(heading=heading)
    return distance * math.cos(heading), distance * math.sin(heading), rise


def min_grip_height(grips: Grips) -> float:
    """Return the height of the lowest gripper [m]."""
    return float(grip_points(grips)[:, 2].min())


def compute_rise(height: float, grips: Grips) -> float:
    """Return how far [m] the lowest gripper rises to a height above the table.

    Raises:
        InvalidInput: the height is not above the gripper.
    """
    start = min_grip_height(grips)
    if not height > start or math.isinf(height):
        raise InvalidInput(
            "height above the table",
            got=f"{height:g} m",
            expected=f"more than the grips' own: the lowest is at {start:g} m",
            remedy="lower the grips, or ask for more height",
        )
    return height - start


def grip_points(grips: Grips) -> Tensor:
    """Return where the grippers hold: [G, 3] m.

    Raises:
        InvalidInput: ``grips`` are not finite positions.
    """
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


def check_positive(**values: float) -> None:
    """Refuse values that are not finite and above 0.

    Raises:
        InvalidInput: names the first wrong one.
    """
    for name, value in values.items():
        if not (math.isfinite(value) and value > 0):
            raise InvalidInput(name, got=f"{value:g}", expected="a finite value > 0")


def check_finite(**values: float) -> None:
    """Refuse values that are not finite.

    Raises:
        InvalidInput: names the first wrong one.
    """
    for name, value in values.items():
        if not math.isfinite(value):
            raise InvalidInput(name, got=value, expected="a finite number")


def check_whole(**values: float) -> None:
    """Refuse values that are not whole numbers of at least 1.

    Raises:
        InvalidInput: names the first wrong one.
    """
    for name, value in values.items():
        if not (1 <= value < math.inf and value == int(value)):
            raise InvalidInput(name, got=value, expected="a whole number >= 1")


def _sample(moves: Sequence[Move], limits: GripperLimits) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Times [K] s, shifts [K, 3] m, rolls [K] rad and separations [K, 1] m, of one move after the other."""
    zero = torch.zeros(1, dtype=torch.float64)
    times, shifts, rolls, separations = [zero], [torch.zeros(1, 3, dtype=torch.float64)], [zero], [zero[:, None]]
    for move in moves:
        duration = _min_duration(move, limits)
        if duration > MAX_MOVE_DURATION_S:
            raise InvalidInput(
                "speed or acceleration",
                got=f"{limits.speed:g} m/s and {limits.acceleration:g} m/s^2, with which a move takes {duration:.3g} s",
                expected=f"at most {MAX_MOVE_DURATION_S:g} s",
                remedy="ask for more of them",
            )
        s = _path_fractions(max(MIN_MOVE_KNOT_INTERVALS, math.ceil(duration / PATH_KNOT_PERIOD_S)))
        times.append(times[-1][-1] + duration * torch.linspace(0, 1, len(s), dtype=s.dtype)[1:])
        shifts.append(shifts[-1][-1] + _displacement(move, s)[1:])
        rolls.append(rolls[-1][-1] + move.roll * s[1:])
        separations.append(separations[-1][-1] + move.separation * s[1:, None])
    return torch.cat(times), torch.cat(shifts), torch.cat(rolls), torch.cat(separations)


def _min_duration(move: Move, limits: GripperLimits) -> float:
    """Shortest duration [s] within the limits: 15/8 L / speed or sqrt(10/sqrt(3) L / acceleration) on a straight L."""
    s = _path_fractions(DURATION_SAMPLES)
    path = _displacement(move, s)
    if move.separation:  # counted as perpendicular to the shift, which is the worst case
        path = torch.cat([path, 0.5 * move.separation * s[:, None]], dim=-1)
    speed = path.diff(dim=0).norm(dim=-1).max() * DURATION_SAMPLES
    acceleration = path.diff(n=2, dim=0).norm(dim=-1).max() * DURATION_SAMPLES**2
    return max(float(speed) / limits.speed, math.sqrt(float(acceleration) / limits.acceleration), move.min_duration)


def _displacement(move: Move, s: Tensor) -> Tensor:
    """Displacement [K, 3] m at fractions ``s`` [K] of the path."""
    straight, bow = (torch.tensor(vector, dtype=s.dtype) for vector in (move.shift, move.bow))
    fraction = (1 - torch.cos(math.pi * s)) / 2 if any(move.bow) else s
    return fraction[:, None] * straight + torch.sin(math.pi * s)[:, None] * bow


def _path_fractions(intervals: int) -> Tensor:
    return minimum_jerk(torch.linspace(0, 1, intervals + 1, dtype=torch.float64))


def _roll_rotations(roll: Tensor, heading: float) -> Tensor:
    """Rotations [K, 3, 3] about the horizontal axis that carries up into the heading."""
    x, y = -math.sin(heading), math.cos(heading)
    cross = torch.tensor([[0.0, 0.0, y], [0.0, 0.0, -x], [-y, x, 0.0]], dtype=torch.float64)
    angle = roll[:, None, None]
    return torch.eye(3, dtype=torch.float64) + torch.sin(angle) * cross + (1 - torch.cos(angle)) * (cross @ cross)


def _separation_axis(start: Tensor, needed: bool) -> Tensor:
    """[G, 3], half a unit vector from the other gripper to each; zero if no move separates them."""
    if not needed:
        return torch.zeros_like(start)
    if len(start) != 2:
        raise InvalidInput("grips", got=f"{len(start)} gripper(s)", expected="two, to be moved apart")
    line = start[0] - start[1]
    if not float(line.norm()) > 0:
        raise InvalidInput("grips", got="two grippers at one place", expected="two places")
    return 0.5 * torch.stack([line, -line]) / line.norm()
