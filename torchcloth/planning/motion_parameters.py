"""What may be added to the motion of a gripper: joint angles of its arm, or shifts and turns of a free hand.

Added is a cubic spline through waypoints at even times, at rest at both ends (C2), so everything below is linear in the
waypoints: position, velocity and acceleration at any instant, and with them the limits.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from scipy.interpolate import PchipInterpolator
from torch import Tensor

from ..recordings import JointMotion
from ..robots import Arm  # pyright: ignore[reportMissingImports] - mapped from robots/ at installation
from ..robots.primitives import Limits  # pyright: ignore[reportMissingImports]
from ..robots.spline import Spline  # pyright: ignore[reportMissingImports]
from ..types import Trajectory
from .deceleration import Halt

PERIOD = 0.02  # s, between the instants at which limits are held
OVER = 3  # periods to either side, over which a recorded motion's accelerations are taken: measured joints tremble
NUDGE = 1e-4  # s, by which what is added, which is smooth, is differentiated
TURNING = Limits(speed=2.0, acceleration=10.0)  # rad/s and rad/s^2, of what a hand that no arm moves is turned more
ORDERS = ("position", "velocity", "acceleration")
MET = 1e-12  # of room: there is none


class Span(NamedTuple):
    """Times of what is added."""

    begin: float  # s, from which on something is
    end: float  # s, after which nothing changes any more
    waypoints: int  # after the beginning, where nothing is added
    halting: float = 0.0  # s after the end, in which what was recorded under way comes to rest

    def basis(self, times: Tensor) -> Tensor:
        """[N, K], what each waypoint adds at ``times`` [N] s."""
        each = torch.cat([torch.zeros(1, self.waypoints), torch.eye(self.waypoints)]).double()
        return Spline.through(self.knots, each).at(times.double().clamp(self.begin, self.end))[0]

    @property
    def knots(self) -> Tensor:
        """[K + 1] s, of the beginning and of the waypoints."""
        return torch.linspace(self.begin, self.end, self.waypoints + 1, dtype=torch.float64)

    @property
    def instants(self) -> Tensor:
        """[N] s, where limits are held: those of the waypoints, where accelerations are greatest, among them."""
        count = math.ceil((self.end - self.begin) / PERIOD) + 1
        even = torch.linspace(self.begin, self.end, count, dtype=torch.float64)
        after = self.end + torch.linspace(0.0, self.halting, math.ceil(self.halting / PERIOD) + 1, dtype=torch.float64)
        return torch.cat([even, self.knots, after]).unique()


class Bounds(NamedTuple):
    """low <= rows @ unknowns <= high: limits of positions, velocities, accelerations; to add nothing is within."""

    rows: Tensor  # [R, N]
    low: Tensor  # [R]
    high: Tensor  # [R]
    names: list[str]  # [R], what each is about
    group: Tensor  # [R] int64, which coordinate of which gripper a row is about,
    groups: Tensor  # [N] int64, and an unknown belongs to: no row is about two of them

    @staticmethod
    def of(courses: Sequence[Course]) -> Bounds:
        """All of several courses, whose waypoints [K, C] follow each other flat."""
        every = [course.bounds() for course in courses]
        rows = torch.block_diag(*(b.rows for b in every))
        low, high = (torch.cat([getattr(b, end) for b in every]) for end in ("low", "high"))
        first = np.cumsum([0, *(int(b.groups.max()) + 1 for b in every)]).tolist()
        group, groups = (
            torch.cat([k + getattr(b, end) for k, b in zip(first, every, strict=False)]) for end in ("group", "groups")
        )
        return Bounds(rows, low, high, [name for b in every for name in b.names], group, groups)

    def nearest(self, at: Tensor) -> tuple[float, str]:
        """(share of the way to the first limit, from where nothing is added; whose limit of what)."""
        reached = self.rows @ at
        room = self.high.where(reached > 0, -self.low)
        share = (reached.abs() / room.clamp(min=MET)).where(reached.abs() > MET, 0.0)
        first = int(share.argmax())
        return min(float(share[first]), 1.0), self.names[first]


@dataclass(frozen=True, eq=False)
class Course(ABC):
    """The motion of one gripper, to which [K, C] waypoints may be added.

    Attributes:
        name: of the gripper.
        t: [S] s, knots as recorded, and of the wait after them.
        closed: [S] bool.
        span: when something is added.
        halt: how the recorded motion ends.
    """

    name: str
    t: Tensor
    closed: Tensor
    span: Span
    halt: Halt

    @property
    @abstractmethod
    def start(self) -> Tensor:
        """[S, C], coordinates as recorded."""

    @abstractmethod
    def trajectory(self, waypoints: Tensor) -> Trajectory:
        """The poses with these [K, C] added; differentiable."""

    @property
    @abstractmethod
    def labels(self) -> list[str]:
        """[C] names of the coordinates."""

    @abstractmethod
    def _limits(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """[C] each: least and largest coordinate, fastest, hardest acceleration."""

    @property
    def nothing(self) -> Tensor:
        """[K, C] waypoints that add nothing."""
        return torch.zeros(self.span.waypoints, self.start.shape[1], dtype=torch.float64)

    def coordinates(self, waypoints: Tensor) -> Tensor:
        """[S, C] with these [K, C] added."""
        return self.start + self.span.basis(self.t) @ waypoints

    def at_instants(self, waypoints: Tensor) -> Tensor:
        """[N, C] of ``span.instants`` with these [K, C] added."""
        at = self.span.instants
        return between(self.t, self.start, at) + self.span.basis(at) @ waypoints

    def bounds(self) -> Bounds:
        """Within the limits, or within what the recorded motion does where that is beyond them."""
        least, largest, fastest, hardest = self._limits()
        eye, parts = torch.eye(self.start.shape[1], dtype=torch.float64), []
        begin, end = self.span.begin, self.span.end
        every, recorded = self.span.instants, lambda times: between(self.t, self.start, times)
        for order, ends in ((0, (least, largest)), (1, (-fastest, fastest)), (2, (-hardest, hardest))):
            step = PERIOD if order < 2 else OVER * PERIOD
            at = every if order == 0 else every[every <= end]  # then it halts, no faster or harder than it may
            within = at if order == 0 else at.clamp(begin + step, end - step)  # neither what came before, nor the halt
            before = _derivative(recorded, within, order, step)
            inside = at.clamp(begin + NUDGE, end - NUDGE)  # at its ends accelerations are greatest
            more = _derivative(self.span.basis, inside if order == 2 else at, order, NUDGE)
            low, high = (ends[0] - before).clamp(max=0.0), (ends[1] - before).clamp(min=0.0)
            names = [f"{ORDERS[order]} of {label} of {self.name}" for label in self.labels] * len(at)
            parts.append((torch.kron(more, eye), low.flatten(), high.flatten(), names))
        rows, low, high, names = zip(*parts, strict=True)
        numbers, told = torch.arange(len(eye)), [name for own in names for name in own]
        group, groups = numbers.repeat(len(told) // len(eye)), numbers.repeat(self.span.waypoints)
        return Bounds(torch.cat(rows), torch.cat(low), torch.cat(high), told, group, groups)


@dataclass(frozen=True, eq=False)
class ArmCourse(Course):
    """Joint angles [rad] (or m) of an arm, within its soft limits."""

    arm: Arm
    q: Tensor  # [S, J]
    acceleration: float  # rad/s^2, at most

    @property
    def start(self) -> Tensor:
        """[S, J] rad."""
        return self.q

    @property
    def labels(self) -> list[str]:
        """Of the joints."""
        return list(self.arm.joint_names)

    def trajectory(self, waypoints: Tensor) -> Trajectory:
        """Through the arm's kinematics."""
        return Trajectory(self.t, self.arm(self.coordinates(waypoints)), self.closed)

    def _limits(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        limits = self.arm.limits
        return (
            limits.soft_lower,
            limits.soft_upper,
            limits.velocity,
            torch.full_like(limits.velocity, self.acceleration),
        )

    def joints(self, waypoints: Tensor) -> JointMotion:
        """As a recording stores it."""
        q = self.coordinates(waypoints).detach().numpy()
        return JointMotion(self.t.numpy(), q, closed=self.closed.numpy())


@dataclass(frozen=True, eq=False)
class HandCourse(Course):
    """Shifts [m] and turns [rad, a rotation vector in world axes] of a gripper that no arm is named for."""

    pose: Tensor  # [S, 4, 4] m
    limits: Limits  # of the shifts along each axis
    lowest: float  # m, of its origin: a table

    @property
    def start(self) -> Tensor:
        """[S, 6]: places, and no turn."""
        return torch.cat([self.pose[:, :3, 3], torch.zeros_like(self.pose[:, :3, 3])], 1)

    @property
    def labels(self) -> list[str]:
        """Of shifts and turns."""
        return ["x", "y", "z", "turn about x", "turn about y", "turn about z"]

    def trajectory(self, waypoints: Tensor) -> Trajectory:
        """Shifted, and turned about the gripper's origin."""
        place, turn = self.coordinates(waypoints).split(3, dim=1)
        top = torch.cat([rotation(turn) @ self.pose[:, :3, :3], place[:, :, None]], dim=2)
        return Trajectory(self.t, torch.cat([top, self.pose[:, 3:]], dim=1), self.closed)

    def _limits(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        far = torch.full((6,), math.inf, dtype=torch.float64)
        least = -far
        least[2] = self.lowest
        speed, hardest = ([a] * 3 + [b] * 3 for a, b in zip(self.limits, TURNING, strict=True))
        return least, far, torch.tensor(speed).double(), torch.tensor(hardest).double()


def rotation(turn: Tensor) -> Tensor:
    """[..., 3, 3] of rotation vectors [..., 3] rad."""
    x, y, z = turn.unbind(-1)
    zero = torch.zeros_like(x)
    rows = [torch.stack(row, -1) for row in ((zero, -z, y), (z, zero, -x), (-y, x, zero))]
    return torch.linalg.matrix_exp(torch.stack(rows, -2))


def between(t: Tensor, values: Tensor, times: Tensor) -> Tensor:
    """[N, C] at ``times`` [N] of values [S, C] at ``t`` [S]: cubics without overshoot (C1), held beyond the ends."""
    curve = PchipInterpolator(t.numpy(), values.detach().double().numpy(), axis=0)
    return torch.as_tensor(curve(times.clamp(float(t[0]), float(t[-1])).numpy()))


def _derivative(function, times: Tensor, order: int, step: float) -> Tensor:
    """[N, C] of a function of times, by differences."""
    if order == 0:
        return function(times)
    if order == 1:
        return (function(times + step / 2) - function(times - step / 2)) / step
    return (function(times + step) - 2 * function(times) + function(times - step)) / step**2
