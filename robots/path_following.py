"""Joint motions by which one arm follows a path of its gripper, best first."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchcloth.errors import InvalidInput
from torchcloth.types import Trajectory

from . import trajectories
from .arm import Arm
from .collision_checks import COLLISION_CHECK_PERIOD_S
from .grasp_orientations import CANDIDATE_ELBOW_OFFSETS_RAD, GraspOrientation
from .inverse import UnreachablePose, solve_inverse_kinematics
from .spline import ClampedSpline, subdivide_times

COARSE_POSES = 6  # poses of the path by which all orientations are ranked first
FINE_POSES = 24  # poses by which the best of them are ranked again, with several postures of the arm
MAX_REFINED_ORIENTATIONS = 4
DWELL_KNOT_PERIOD_S = 0.02  # largest time between knots while the gripper stands still
COARSE_IK_ITERATIONS = 30  # for a pose while orientations are ranked
COARSE_IK_TOLERANCE = 1e-6  # m and rad, in one norm
PATH_IK_ITERATIONS = 100
PATH_IK_TOLERANCE = 1e-9  # m and rad, in one norm
LIMIT_CHECK_PERIOD_S = 0.005  # largest time between two checks of the limits
SOFT_LIMIT_TOLERANCE = 1e-4  # rad or m, by which a spline may exceed a soft limit between two knots within it
MAX_PATH_ERROR_M = 1e-4  # largest distance of the gripper from its path


class RequiredSlowdown(NamedTuple):
    """How much a joint motion must be slowed down to satisfy one limit, and where that limit is met.

    Attributes:
        factor: of the duration; at most 1 if the limit is satisfied.
        quantity: "velocity" or "acceleration".
        joint: its number.
        time: s.
        value: rad/s or rad/s^2 (m/s, m/s^2), at that time.
        limit: in the unit of ``value``.
    """

    factor: float
    quantity: str
    joint: int
    time: float
    value: float
    limit: float


class JointPath(NamedTuple):
    """One joint motion that follows the path.

    Attributes:
        orientation: of the tool.
        spline: the joint motion.
        slowdown: what the limits of velocity and acceleration require.
    """

    orientation: GraspOrientation
    spline: ClampedSpline
    slowdown: RequiredSlowdown


CollisionCheck = Callable[
    [Tensor, Tensor], InvalidInput | None
]  # (joint positions [T, J], times [T] s) -> error or None


class PathTask(NamedTuple):
    """The task of one arm.

    Attributes:
        arm: the kinematics.
        path: of its gripper.
        approach: [3], see ``approach_heading``.
        acceleration: [J] rad/s^2, largest accelerations allowed.
        check_collisions: returns an error if joint positions [T, J] at times [T] s collide.
    """

    arm: Arm
    path: Trajectory
    approach: Tensor
    acceleration: Tensor
    check_collisions: CollisionCheck


def densify_dwells(path: Trajectory) -> Trajectory:
    """Return the path with more knots where it stands still: a spline rings across knots that are far apart."""
    t, pose, closed = path
    still = (pose[1:] == pose[:-1]).all(dim=(-1, -2))
    counts = torch.where(still, (t.diff() / DWELL_KNOT_PERIOD_S).ceil().long().clamp(min=1), 1)
    knot = torch.repeat_interleave(torch.arange(len(counts)), counts)
    within = torch.arange(len(knot)) - torch.repeat_interleave(counts.cumsum(0) - counts, counts)
    times = t[knot] + t.diff()[knot] * within / counts[knot]
    knot = torch.cat([knot, torch.tensor([len(t) - 1])])
    return Trajectory(torch.cat([times, t[-1:]]), pose[knot], closed[knot])


def rank_orientations(task: PathTask, orientations: Sequence[GraspOrientation]) -> Iterator[GraspOrientation]:
    """Yield the orientations that can follow the path, roughly in the order of the slowdown that they require.

    Raises:
        InvalidInput: no orientation can; names the joints or solids that stop the one that comes farthest.
    """
    if len(orientations) == 1:
        yield orientations[0]
        return
    coarse, coarse_failures = _rank(task, COARSE_POSES, orientations)
    if not coarse:
        raise max(coarse_failures, key=lambda failure: failure[0])[1]
    postures = [
        orientation._replace(elbow_offset=elbow)
        for orientation in coarse[:MAX_REFINED_ORIENTATIONS]
        for elbow in CANDIDATE_ELBOW_OFFSETS_RAD
    ]
    fine, fine_failures = _rank(task, FINE_POSES, postures)
    if not fine and not coarse[MAX_REFINED_ORIENTATIONS:]:
        raise max(fine_failures, key=lambda failure: failure[0])[1]
    yield from fine
    yield from coarse[MAX_REFINED_ORIENTATIONS:]


def solve_joint_path(task: PathTask, orientation: GraspOrientation) -> JointPath:
    """Compute the joint motion through every knot of the path.

    Raises:
        InvalidInput: a pose is out of reach, a soft limit is exceeded, the gripper strays from the path between knots,
            or the arm collides.
    """
    arm, path = task.arm, task.path
    (q,) = _solve(task, slice(None), [orientation], PATH_IK_TOLERANCE, PATH_IK_ITERATIONS)
    if isinstance(q, UnreachablePose):
        raise _with_time(q, float(path.t[q.pose_index]))
    spline = ClampedSpline(path.t, q)
    q, times = spline.sample(LIMIT_CHECK_PERIOD_S)
    excess = torch.maximum(arm.limits.soft_lower - q, q - arm.limits.soft_upper)
    if float(excess.max()) > SOFT_LIMIT_TOLERANCE:
        at, joint = divmod(int(excess.argmax()), q.shape[1])
        raise InvalidInput(
            f"the motion breaks the soft limit of {arm.joint_names[joint]!r} at t = {float(times[at]):.3g} s",
            got=f"{float(q[at, joint]):.4g}",
            expected=f"{float(arm.limits.soft_lower[joint]):.4g} to {float(arm.limits.soft_upper[joint]):.4g}",
            remedy="move the path, or choose another orientation",
        )
    _check_tracking(arm, path, spline)
    if error := task.check_collisions(*spline.sample(COLLISION_CHECK_PERIOD_S)):
        raise error
    return JointPath(orientation, spline, required_slowdown(arm, spline, task.acceleration))


def required_slowdown(arm: Arm, spline: ClampedSpline, acceleration: Tensor) -> RequiredSlowdown:
    """Return the limit that requires most slowing down: a velocity, or an acceleration ``[J]``."""
    times = subdivide_times(spline.t, LIMIT_CHECK_PERIOD_S)
    slowdowns = []
    for quantity, value, t, limit, power in (
        ("velocity", spline.velocities(times).abs(), times, arm.limits.velocity, 1.0),
        ("acceleration", spline.knot_accelerations().abs(), spline.t, acceleration, 0.5),
    ):
        ratio = value / limit
        at, joint = divmod(int(ratio.argmax()), ratio.shape[1])
        factor = float(ratio[at, joint]) ** power
        slowdowns.append(
            RequiredSlowdown(factor, quantity, joint, float(t[at]), float(value[at, joint]), float(limit[joint]))
        )
    return max(slowdowns)


def _rank(
    task: PathTask, count: int, orientations: Sequence[GraspOrientation]
) -> tuple[list[GraspOrientation], list[tuple[float, InvalidInput]]]:
    """Orientations that reach about ``count`` knots of the path, fastest first; time and error of the others."""
    knots = _spread_knots(task.path, count)
    times = task.path.t[knots]
    reachable, failed = [], []
    for orientation, q in zip(
        orientations, _solve(task, knots, orientations, COARSE_IK_TOLERANCE, COARSE_IK_ITERATIONS), strict=True
    ):
        if isinstance(q, UnreachablePose):
            time = float(times[q.pose_index])
            failed.append((time, _with_time(q, time)))
            continue
        if error := task.check_collisions(q, times):
            failed.append((float(times[-1]), error))
            continue
        slowdown = required_slowdown(task.arm, ClampedSpline(times, q), task.acceleration)
        reachable.append((slowdown.factor, orientation))
    return [orientation for _, orientation in sorted(reachable)], failed


def _spread_knots(path: Trajectory, count: int) -> Tensor:
    """Indices of about ``count`` knots, the first and the last among them."""
    return torch.linspace(0, len(path.t) - 1, min(count, len(path.t))).round().long().unique()


def _solve(
    task: PathTask, knots: Tensor | slice, orientations: Sequence[GraspOrientation], tolerance: float, iterations: int
) -> list[Tensor | UnreachablePose]:
    pose = task.path.pose[knots].to(task.arm.base).repeat(len(orientations), 1, 1, 1)
    turn = torch.stack([orientation.tool_rotation(task.approach.to(pose)) for orientation in orientations])
    pose[..., :3, :3] = pose[..., :3, :3] @ turn[:, None]
    reference = torch.stack([orientation.reference_posture(task.arm) for orientation in orientations])
    return solve_inverse_kinematics(task.arm, pose, reference, reference, tolerance, iterations)


def _with_time(error: UnreachablePose, time: float) -> InvalidInput:
    what = f"{error.what}, at t = {time:.3g} s of the path"
    return InvalidInput(what, got=error.got, remedy="move the grips or the path, or choose another orientation")


def _check_tracking(arm: Arm, path: Trajectory, spline: ClampedSpline) -> None:
    """Check that the gripper stays on the path between the knots as well, where the layer interpolates it."""
    sampled = trajectories.interpolate(path.pose[:, :3, 3], path.t, None, LIMIT_CHECK_PERIOD_S)
    error = (arm(spline.positions(sampled.t))[:, :3, 3] - sampled.q).norm(dim=-1)
    if float(error.max()) > MAX_PATH_ERROR_M:
        raise InvalidInput(
            f"the joints stray from the path at t = {float(sampled.t[error.argmax()]):.3g} s",
            got=f"{float(error.max()):.2g} m",
            expected=f"at most {MAX_PATH_ERROR_M:g} m",
            remedy="give the path at more knots, or keep it away from the edge of the arm's reach",
        )
