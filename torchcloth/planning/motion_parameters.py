"""Parametrised changes of a gripper's motion: joint angles of its arm, or shifts and turns of a free gripper.

A cubic spline through evenly spaced waypoints is added to the recorded motion. It is at rest at both ends (C2).
Position, velocity and acceleration at any time are therefore linear in the waypoints, and so are the limits.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from scipy.interpolate import PchipInterpolator
from torch import Tensor

from ..recordings import JointMotion
from ..robots import Arm  # pyright: ignore[reportMissingImports] - mapped from robots/ at installation
from ..robots.primitives import GripperLimits  # pyright: ignore[reportMissingImports]
from ..robots.spline import ClampedSpline  # pyright: ignore[reportMissingImports]
from ..types import Trajectory
from .deceleration import Deceleration

BOUND_CHECK_PERIOD_S = 0.02  # largest time between two checks of the limits
RECORDED_ACCELERATION_PERIODS = 3  # step of the finite differences of a recorded motion; measured joints tremble
SPLINE_DIFFERENCE_STEP_S = 1e-4  # step of the finite differences of the added spline, which is smooth
FREE_GRIPPER_TURN_LIMITS = GripperLimits(speed=2.0, acceleration=10.0)  # rad/s and rad/s^2, of an added rotation
DERIVATIVE_NAMES = ("position", "velocity", "acceleration")
MIN_ROOM_TO_LIMIT = 1e-12  # a smaller distance to a limit counts as none


class SplineSpan(NamedTuple):
    """The times of the added spline.

    Attributes:
        begin: s, start of the spline, where nothing is added.
        end: s, after which the added value is constant.
        waypoints: number of waypoints after ``begin``.
        deceleration_time: s after ``end``, in which a recorded motion that is under way comes to rest.
    """

    begin: float
    end: float
    waypoints: int
    deceleration_time: float = 0.0

    def basis(self, times: Tensor) -> Tensor:
        """Return how much each waypoint adds: [N, K] at ``times`` [N] s."""
        unit = torch.cat([torch.zeros(1, self.waypoints), torch.eye(self.waypoints)]).double()
        return ClampedSpline(self.knots, unit).positions(times.double().clamp(self.begin, self.end))

    @property
    def knots(self) -> Tensor:
        """Times [K + 1] s of the beginning and of the waypoints."""
        return torch.linspace(self.begin, self.end, self.waypoints + 1, dtype=torch.float64)

    @property
    def bound_check_times(self) -> Tensor:
        """Times [N] s at which limits are checked; they include the waypoints, where accelerations are largest."""
        count = math.ceil((self.end - self.begin) / BOUND_CHECK_PERIOD_S) + 1
        even = torch.linspace(self.begin, self.end, count, dtype=torch.float64)
        count = math.ceil(self.deceleration_time / BOUND_CHECK_PERIOD_S) + 1
        after = self.end + torch.linspace(0.0, self.deceleration_time, count, dtype=torch.float64)
        return torch.cat([even, self.knots, after]).unique()


class LinearBounds(NamedTuple):
    """Limits of positions, velocities and accelerations: low <= rows @ unknowns <= high. Zero unknowns satisfy them.

    Attributes:
        rows: [R, N], coefficients.
        low: [R], lower limits.
        high: [R], upper limits.
        names: R names, what each row limits.
    """

    rows: Tensor
    low: Tensor
    high: Tensor
    names: list[str]

    @staticmethod
    def concatenate(motions: Sequence[GripperMotionParameters]) -> LinearBounds:
        """Join the limits of several grippers, whose waypoints [K, C] follow each other, flattened."""
        parts = [motion.bounds() for motion in motions]
        rows = torch.block_diag(*(b.rows for b in parts))
        low, high = torch.cat([b.low for b in parts]), torch.cat([b.high for b in parts])
        return LinearBounds(rows, low, high, [name for b in parts for name in b.names])

    def nearest_limit(self, at: Tensor) -> tuple[float, str]:
        """Return the fraction of the way from zero unknowns to the first limit, and the name of that limit."""
        value = self.rows @ at
        room = self.high.where(value > 0, -self.low)
        fraction = (value.abs() / room.clamp(min=MIN_ROOM_TO_LIMIT)).where(value.abs() > MIN_ROOM_TO_LIMIT, 0.0)
        first = int(fraction.argmax())
        return min(float(fraction[first]), 1.0), self.names[first]


@dataclass(frozen=True, eq=False)
class GripperMotionParameters(ABC):
    """The motion of one gripper, to which waypoints [K, C] of C coordinates may be added.

    Attributes:
        name: of the gripper.
        t: [S] s, knots of the recorded motion and of the wait after it.
        closed: [S] bool, whether the gripper holds the cloth from this knot on.
        span: the times of the added spline.
        deceleration: how the recorded motion comes to rest after its end.
    """

    name: str
    t: Tensor
    closed: Tensor
    span: SplineSpan
    deceleration: Deceleration
    _knot_basis: Tensor = field(init=False, repr=False)

    def __post_init__(self) -> None:
        # Computed here, because numpy cannot read tensors inside a function transform such as jacfwd.
        object.__setattr__(self, "_knot_basis", self.span.basis(self.t))

    @property
    @abstractmethod
    def recorded_coordinates(self) -> Tensor:
        """Coordinates [S, C] of the recorded motion."""

    @abstractmethod
    def trajectory(self, waypoints: Tensor) -> Trajectory:
        """Return the poses with the waypoints [K, C] added; differentiable."""

    @property
    @abstractmethod
    def coordinate_names(self) -> list[str]:
        """Names of the C coordinates."""

    @abstractmethod
    def _limits(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Smallest and largest value, largest speed and largest acceleration of each coordinate, [C] each."""

    @property
    def zero_waypoints(self) -> Tensor:
        """Waypoints [K, C] that add nothing."""
        return torch.zeros(self.span.waypoints, self.recorded_coordinates.shape[1], dtype=torch.float64)

    def coordinates(self, waypoints: Tensor) -> Tensor:
        """Return the coordinates [S, C] at the knots with the waypoints [K, C] added."""
        return self.recorded_coordinates + self._knot_basis @ waypoints

    def coordinates_at_check_times(self, waypoints: Tensor) -> Tensor:
        """Return the coordinates [N, C] at ``span.bound_check_times`` with the waypoints [K, C] added."""
        times = self.span.bound_check_times
        return interpolate_monotone(self.t, self.recorded_coordinates, times) + self.span.basis(times) @ waypoints

    def bounds(self) -> LinearBounds:
        """Return the limits of the waypoints; where the recorded motion exceeds a limit, its own value is the limit."""
        smallest, largest, speed, acceleration = self._limits()
        identity, parts = torch.eye(self.recorded_coordinates.shape[1], dtype=torch.float64), []
        begin, end = self.span.begin, self.span.end
        check_times = self.span.bound_check_times

        def recorded(times: Tensor) -> Tensor:
            return interpolate_monotone(self.t, self.recorded_coordinates, times)

        for order, (low, high) in enumerate(((smallest, largest), (-speed, speed), (-acceleration, acceleration))):
            step = BOUND_CHECK_PERIOD_S if order < 2 else RECORDED_ACCELERATION_PERIODS * BOUND_CHECK_PERIOD_S
            # After the end the gripper decelerates within its limits, so only positions are checked there.
            times = check_times if order == 0 else check_times[check_times <= end]
            # Finite differences use neither the motion before the first frame nor the deceleration.
            recorded_value = _derivative(
                recorded, times if order == 0 else times.clamp(begin + step, end - step), order, step
            )
            # Accelerations of the spline are largest at its ends.
            inside = times.clamp(begin + SPLINE_DIFFERENCE_STEP_S, end - SPLINE_DIFFERENCE_STEP_S)
            basis = _derivative(self.span.basis, inside if order == 2 else times, order, SPLINE_DIFFERENCE_STEP_S)
            low, high = (low - recorded_value).clamp(max=0.0), (high - recorded_value).clamp(min=0.0)
            names = [f"{DERIVATIVE_NAMES[order]} of {label} of {self.name}" for label in self.coordinate_names]
            parts.append((torch.kron(basis, identity), low.flatten(), high.flatten(), names * len(times)))
        rows, lows, highs, names = zip(*parts, strict=True)
        return LinearBounds(torch.cat(rows), torch.cat(lows), torch.cat(highs), [n for part in names for n in part])


@dataclass(frozen=True, eq=False)
class ArmMotionParameters(GripperMotionParameters):
    """Joint angles [rad] (or [m]) of an arm, within its soft limits.

    Attributes:
        arm: the kinematics.
        q: [S, J] rad, recorded joint angles.
        max_acceleration: rad/s^2, of any joint.
    """

    arm: Arm
    q: Tensor
    max_acceleration: float

    @property
    def recorded_coordinates(self) -> Tensor:
        """Joint angles [S, J] rad of the recorded motion."""
        return self.q

    @property
    def coordinate_names(self) -> list[str]:
        """Names of the joints."""
        return list(self.arm.joint_names)

    def trajectory(self, waypoints: Tensor) -> Trajectory:
        """Return the poses by the arm's kinematics, with the waypoints [K, J] added; differentiable."""
        return Trajectory(self.t, self.arm(self.coordinates(waypoints)), self.closed)

    def _limits(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        limits = self.arm.limits
        return (
            limits.soft_lower,
            limits.soft_upper,
            limits.velocity,
            torch.full_like(limits.velocity, self.max_acceleration),
        )

    def joint_motion(self, waypoints: Tensor) -> JointMotion:
        """Return the joint angles with the waypoints [K, J] added, as a recording stores them."""
        q = self.coordinates(waypoints).detach().numpy()
        return JointMotion(self.t.numpy(), q, closed=self.closed.numpy())


@dataclass(frozen=True, eq=False)
class FreeGripperMotionParameters(GripperMotionParameters):
    """Shifts [m] and rotations [rad, a rotation vector in world axes] of a gripper without an arm.

    Attributes:
        pose: [S, 4, 4] m, recorded poses.
        limits: of the shifts along each axis.
        min_height: m, lowest height of the gripper's origin: the table, or lower where the recording is.
    """

    pose: Tensor
    limits: GripperLimits
    min_height: float

    @property
    def recorded_coordinates(self) -> Tensor:
        """Positions [m] and zero rotations of the recorded motion, [S, 6]."""
        return torch.cat([self.pose[:, :3, 3], torch.zeros_like(self.pose[:, :3, 3])], 1)

    @property
    def coordinate_names(self) -> list[str]:
        """Names of the three shifts and the three rotations."""
        return ["x", "y", "z", "turn about x", "turn about y", "turn about z"]

    def trajectory(self, waypoints: Tensor) -> Trajectory:
        """Return the poses with the waypoints [K, 6] added; differentiable.

        Rotations are about the gripper's origin.
        """
        place, turn = self.coordinates(waypoints).split(3, dim=1)
        top = torch.cat([rotation_matrix(turn) @ self.pose[:, :3, :3], place[:, :, None]], dim=2)
        return Trajectory(self.t, torch.cat([top, self.pose[:, 3:]], dim=1), self.closed)

    def _limits(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        infinite = torch.full((6,), math.inf, dtype=torch.float64)
        smallest = -infinite
        smallest[2] = self.min_height
        speed, acceleration = ([a] * 3 + [b] * 3 for a, b in zip(self.limits, FREE_GRIPPER_TURN_LIMITS, strict=True))
        return smallest, infinite, torch.tensor(speed).double(), torch.tensor(acceleration).double()


def rotation_matrix(turn: Tensor) -> Tensor:
    """Return the rotation matrices [..., 3, 3] of rotation vectors [..., 3] rad; differentiable."""
    x, y, z = turn.unbind(-1)
    zero = torch.zeros_like(x)
    rows = [torch.stack(row, -1) for row in ((zero, -z, y), (z, zero, -x), (-y, x, zero))]
    return torch.linalg.matrix_exp(torch.stack(rows, -2))


def interpolate_monotone(t: Tensor, values: Tensor, times: Tensor) -> Tensor:
    """Return values [N, C] at ``times`` [N] s by monotone cubic interpolation (PCHIP, C1, no overshoot).

    Args:
        t: [S] s, knots.
        values: [S, C].
        times: [N] s; values beyond the ends are those at the ends.
    """
    curve = PchipInterpolator(t.numpy(), values.detach().double().numpy(), axis=0)
    return torch.as_tensor(curve(times.clamp(float(t[0]), float(t[-1])).numpy()))


def _derivative(function: Callable[[Tensor], Tensor], times: Tensor, order: int, step: float) -> Tensor:
    if order == 0:
        return function(times)
    if order == 1:
        return (function(times + step / 2) - function(times - step / 2)) / step
    return (function(times + step) - 2 * function(times) + function(times - step)) / step**2
