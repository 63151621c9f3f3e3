"""The joint motions by which one arm can follow a path of its gripper, best first."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchcloth.errors import InvalidInput
from torchcloth.types import Trajectory

from . import trajectories
from .arm import Arm
from .collision_checks import STEP
from .grasp_orientations import ELBOWS, Hold
from .inverse import Unreachable, solve
from .spline import Spline

GLANCE = 6  # poses of the path by which all holds are judged first
LOOK = 24  # and then the best of them, with several postures of the arm
BEST = 4
REST = 0.02  # s, between knots of a path that stands still
QUICK = 30  # iterations for a pose while judging
FINE = 0.005  # s, between the samples that limits are checked at
SLACK = 1e-4  # rad or m, by which a spline may pass a soft limit between two knots that keep it
TRACKING = 1e-4  # m, between the path and where the joints lead


class Load(NamedTuple):
    """How hard a joint motion is: the factor of slowing down that one limit asks for, and where it is met."""

    factor: float
    what: str  # "velocity" or "acceleration"
    joint: int
    time: float  # s
    value: float  # rad/s or rad/s^2 (m/s, m/s^2)
    limit: float


class Way(NamedTuple):
    """One joint motion that follows the path."""

    hold: Hold
    spline: Spline
    load: Load


Check = Callable[[Tensor, Tensor], InvalidInput | None]  # of joint positions [T, J] at times [T] s: what is in the way


class Task(NamedTuple):
    """What one arm has to do."""

    arm: Arm
    path: Trajectory
    inward: Tensor  # [3], see ``holds.inward``
    acceleration: Tensor  # [J] rad/s^2, the most allowed
    check: Check


def dense(path: Trajectory) -> Trajectory:
    """The path with more knots where it stands still: a spline rings across knots that are far apart."""
    t, pose, closed = path
    still = (pose[1:] == pose[:-1]).all(dim=(-1, -2))
    counts = torch.where(still, (t.diff() / REST).ceil().long().clamp(min=1), 1)
    knot = torch.repeat_interleave(torch.arange(len(counts)), counts)
    within = torch.arange(len(knot)) - torch.repeat_interleave(counts.cumsum(0) - counts, counts)
    times = t[knot] + t.diff()[knot] * within / counts[knot]
    knot = torch.cat([knot, torch.tensor([len(t) - 1])])
    return Trajectory(torch.cat([times, t[-1:]]), pose[knot], closed[knot])


def ways(task: Task, holds: Sequence[Hold]) -> Iterator[Hold]:
    """Holds that can follow the path, about in the order of how little slower than asked they are.

    Raises:
        InvalidInput: no hold can; names the joints in the way of the one that comes farthest.
    """
    if len(holds) == 1:
        yield holds[0]
        return
    judged, failures = _judge(task, GLANCE, holds)
    if not judged:
        raise max(failures, key=lambda failure: failure[0])[1]
    postures = [hold._replace(elbow=elbow) for hold in judged[:BEST] for elbow in ELBOWS]
    looked, missed = _judge(task, LOOK, postures)
    if not looked and not judged[BEST:]:
        raise max(missed, key=lambda failure: failure[0])[1]
    yield from looked
    yield from judged[BEST:]


def follow(task: Task, hold: Hold) -> Way:
    """The joint motion through every knot of the path.

    Raises:
        InvalidInput: a pose is out of reach, a soft limit is passed, the joints stray from the path between knots, or
            something is in the way.
    """
    arm, path = task.arm, task.path
    (q,) = _solve(task, slice(None), [hold], 1e-9, 100)
    if isinstance(q, Unreachable):
        raise _timed(q, float(path.t[q.pose]))
    spline = Spline.through(path.t, q)
    times = spline.finer(FINE)
    q, _ = spline.at(times)
    beyond = torch.maximum(arm.limits.soft_lower - q, q - arm.limits.soft_upper)
    if float(beyond.max()) > SLACK:
        at, joint = divmod(int(beyond.argmax()), q.shape[1])
        raise InvalidInput(
            f"the motion breaks the soft limit of {arm.joint_names[joint]!r} at t = {float(times[at]):.3g} s",
            got=f"{float(q[at, joint]):.4g}",
            expected=f"{float(arm.limits.soft_lower[joint]):.4g} to {float(arm.limits.soft_upper[joint]):.4g}",
            remedy="move the path, or choose another hold",
        )
    _check_tracking(arm, path, spline)
    if refusal := task.check(*spline.sampled(STEP)):
        raise refusal
    return Way(hold, spline, load(arm, spline, task.acceleration))


def load(arm: Arm, spline: Spline, acceleration: Tensor) -> Load:
    """The limit that asks for most slowing down, of velocity or of acceleration ``[J]``."""
    times = spline.finer(FINE)
    _, velocity = spline.at(times)
    found = []
    for what, value, t, limit, power in (
        ("velocity", velocity.abs(), times, arm.limits.velocity, 1.0),
        ("acceleration", spline.acceleration.abs(), spline.t, acceleration, 0.5),
    ):
        share = value / limit
        at, joint = divmod(int(share.argmax()), share.shape[1])
        factor = float(share[at, joint]) ** power
        found.append(Load(factor, what, joint, float(t[at]), float(value[at, joint]), float(limit[joint])))
    return max(found)


def _judge(task: Task, count: int, holds: Sequence[Hold]) -> tuple[list[Hold], list[tuple[float, InvalidInput]]]:
    """The holds that reach about ``count`` knots of the path, fastest first; time and error of the others."""
    knots = _some(task.path, count)
    times = task.path.t[knots]
    good, bad = [], []
    for hold, q in zip(holds, _solve(task, knots, holds, 1e-6, QUICK), strict=True):
        if isinstance(q, Unreachable):
            time = float(times[q.pose])
            bad.append((time, _timed(q, time)))
            continue
        if refusal := task.check(q, times):
            bad.append((float(times[-1]), refusal))
            continue
        good.append((load(task.arm, Spline.through(times, q), task.acceleration).factor, hold))
    return [hold for _, hold in sorted(good)], bad


def _some(path: Trajectory, count: int) -> Tensor:
    """Indices of about ``count`` knots, the first and the last among them."""
    return torch.linspace(0, len(path.t) - 1, min(count, len(path.t))).round().long().unique()


def _solve(
    task: Task, knots: Tensor | slice, holds: Sequence[Hold], tolerance: float, iterations: int
) -> list[Tensor | Unreachable]:
    pose = task.path.pose[knots].to(task.arm.base).repeat(len(holds), 1, 1, 1)
    turn = torch.stack([hold.rotation(task.inward.to(pose)) for hold in holds])
    pose[..., :3, :3] = pose[..., :3, :3] @ turn[:, None]
    reference = torch.stack([hold.reference(task.arm) for hold in holds])
    return solve(task.arm, pose, reference, reference, tolerance, iterations)


def _timed(error: Unreachable, time: float) -> InvalidInput:
    """The error with the time of the pose."""
    what = f"{error.what}, at t = {time:.3g} s of the path"
    return InvalidInput(what, got=error.got, remedy="move the grips or the path, or choose another hold")


def _check_tracking(arm: Arm, path: Trajectory, spline: Spline) -> None:
    """Between the knots, too, the joints lead where the path goes, as the layer interpolates it."""
    sampled = trajectories.interpolate(path.pose[:, :3, 3], path.t, None, FINE)
    error = (arm(spline.at(sampled.t)[0])[:, :3, 3] - sampled.q).norm(dim=-1)
    if float(error.max()) > TRACKING:
        raise InvalidInput(
            f"the joints stray from the path at t = {float(sampled.t[error.argmax()]):.3g} s",
            got=f"{float(error.max()):.2g} m",
            expected=f"at most {TRACKING:g} m",
            remedy="give the path at more knots, or keep it away from the edge of the arm's reach",
        )
