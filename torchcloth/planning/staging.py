"""From an episode to the courses of its grippers, and from planned courses to an episode."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from .._math import last_knot
from ..boundaries.motion import interpolate
from ..cloth import Cloth
from ..errors import InvalidInput
from ..identification.episodes import RATE, episode
from ..recordings import Recording
from ..recordings.proposed import undone
from ..robots import arm_of, gripper_motion, replay  # pyright: ignore[reportMissingImports] - mapped from robots/
from ..robots.primitives import Limits  # pyright: ignore[reportMissingImports]
from ..robots.replay import model_of, unwound  # pyright: ignore[reportMissingImports]
from ..robots.retrace import LEVEL, highest  # pyright: ignore[reportMissingImports]
from ..robots.spline import Spline  # pyright: ignore[reportMissingImports]
from ..types import Trajectory
from .courses import PERIOD, ArmCourse, Course, HandCourse, Span, between
from .result import PLANNED

NEAREST = 0.1  # s, between waypoints: nearer ones tremble
SAME = 1e-6  # s
STOP = 0.01  # s after the end, in which what still moves is stopped
MOVING = 0.02  # m/s
STRAIGHT = 0.9999  # upward part of a plane's normal


def courses_of(
    cloth: Cloth, recording: Recording, waypoints: int, wait: float, acceleration: float, limits: Limits
) -> list[Course]:
    """Of every gripper that holds the cloth, from the first frame to the end of the motion and a wait.

    Raises:
        InvalidInput: grippers of nothing, one that takes hold on the way, or waypoints that are too near each other.
        RecordingError: no motion for one of the cloth's grasps.
    """
    seen = episode(cloth, recording, RATE)
    every = replay(recording, names=seen.motion)
    names = [name for name in seen.motion if name in recording.grasps and bool(every[name].closed.any())]
    if not names:
        expected = "a gripper that holds the cloth, whose motion to change"
        raise InvalidInput("recording", got="no grasp that is ever closed", expected=expected)
    begin = float(seen.times[0])
    end = min(float(every[name].t[-1]) for name in names)
    if end - begin < waypoints * NEAREST:
        got = f"{waypoints} of {max(end - begin, 0):.3g} s of motion after the first frame"
        remedy = "ask for fewer, or begin with a longer motion"
        raise InvalidInput("waypoints", got=got, expected=f"{NEAREST:g} s or more for each", remedy=remedy)
    span = Span(begin, end, waypoints)
    knots = _knots([every[name].t for name in names], span, wait)
    at = knots.clamp(max=end)  # then all wait, and what was recorded longer as well
    out: list[Course] = []
    for name in names:
        path = every[name]
        closed = path.closed[last_knot(path.t, knots + SAME).clamp(min=0)]
        _check_hold(name, closed)
        if name in recording.joints and name in recording.robots:
            arm = arm_of(recording, name)
            q = between(path.t, torch.as_tensor(unwound(arm, recording.joints[name].q)), at)
            out.append(ArmCourse(name, knots, closed, span, arm, q, acceleration))
        else:
            pose = interpolate(path._replace(pose=path.pose.double()), at)
            table = highest(recording.colliders, pose[:, :2, 3].numpy())
            lowest = min(table, float(pose[:, 2, 3].min()))
            out.append(HandCourse(name, knots, closed, span, pose, limits, lowest))
    return out


def as_episode(recording: Recording, courses: Sequence[Course], waypoints: Sequence[Tensor]) -> Recording:
    """The episode with the planned motions in it, and nothing that was seen or felt."""
    planned = list(zip(courses, waypoints, strict=True))
    grippers = {c.name: gripper_motion(_detached(c.trajectory(z))) for c, z in planned}
    joints = {name: own for name, own in recording.joints.items() if name not in grippers}  # others would be old ones
    joints |= {c.name: c.joints(z) for c, z in planned if isinstance(c, ArmCourse)}
    robots = {name: replace(robot, model=model_of(recording, name)) for name, robot in recording.robots.items()}
    bare = undone(recording, PLANNED)
    return replace(
        bare,
        grippers={**bare.grippers, **grippers},
        joints=joints,
        robots=robots,
        clock_offset=0.0,
        split={**recording.split, "motion": "planned", "replicate_of": None},
        path=None,
    )


def doubts(recording: Recording, courses: Sequence[Course]) -> list[str]:
    """What a reader should know of what was planned from, in sentences."""
    out, begin = [], courses[0].span.begin
    every = replay(recording, names=[course.name for course in courses])
    for course in courses:
        path = every[course.name]
        speed = (path.pose[1:, :3, 3] - path.pose[:-1, :3, 3]).norm(dim=-1) / path.t.diff()
        if begin > float(path.t[0]) + SAME and float(speed[last_knot(path.t, path.t.new_tensor([begin]))[0]]) > MOVING:
            out.append(
                f"{course.name}: the planned motion begins at the first frame, {begin - float(path.t[0]):.2f} s after "
                "the recorded one, which is under way there: bring the arm there as recorded"
            )
    hands = ", ".join(c.name for c in courses if isinstance(c, HandCourse))
    for name, collider in recording.colliders.items() if hands else ():
        if collider.normal[2] <= LEVEL:
            out.append(f"{hands}: {name} stands too steep for a table: nothing is kept off it")
        elif collider.normal[2] < STRAIGHT:
            out.append(f"{hands}: {name} leans: kept is its height below the recorded path, and not beside it")
    if bare := [c.name for c in courses if isinstance(c, HandCourse) and c.name in recording.robots]:
        names = ", ".join(bare)
        out.append(f"{names}: an arm is named, but its joints were not recorded: no limit of a joint is kept")
    return out


def held_until(path: Trajectory, last: float) -> Trajectory:
    """A path that stands still where it ends, until ``last`` [s] at least."""
    end = float(path.t[-1])
    if end >= last:
        return path
    more = path.t.new_tensor([last] if last - end < 2 * STOP else [end + STOP, last])
    still = lambda field: torch.cat([field, field[-1:].expand(len(more), *field.shape[1:])])  # noqa: E731
    return Trajectory(torch.cat([path.t, more]), still(path.pose), still(path.closed))


def _check_hold(name: str, closed: Tensor) -> None:
    """Only increments of a gripper's motion move what it holds: taking hold elsewhere would go unnoticed."""
    if not bool(closed[0]) or bool((closed[1:] & ~closed[:-1]).any()):
        when = "after the first frame" if not bool(closed[0]) else "again"
        raise InvalidInput(
            f"gripper {name!r}",
            got=f"one that takes hold {when}",
            expected="grippers that hold the cloth from the first frame until they let go",
            remedy="plan from an episode that begins when it has closed",
        )


def _knots(times: Sequence[Tensor], span: Span, wait: float) -> Tensor:
    """[S] s: all recorded ones within the span, more where these are far apart, its ends, and those of the wait."""
    every = torch.cat([*times, times[0].new_tensor([span.begin, span.end])])
    inner = every[(every >= span.begin) & (every <= span.end)].unique()
    inner = inner[torch.cat([inner.new_ones(1), inner.diff()]) > SAME]
    inner = Spline(inner, inner[:, None], inner[:, None]).finer(PERIOD)
    after = [] if wait == 0 else [wait] if wait < 2 * STOP else [STOP, wait]
    return torch.cat([inner, span.end + inner.new_tensor(after)])


def _detached(path: Trajectory) -> Trajectory:
    return path._replace(pose=path.pose.detach())
