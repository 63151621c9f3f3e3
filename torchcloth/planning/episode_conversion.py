"""From an episode to the courses of its grippers, and from planned courses to an episode."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from .._utils.linalg import last_knot
from ..boundaries.motion import interpolate
from ..cloth import Cloth
from ..episodes.observed import RATE, episode
from ..errors import InvalidInput
from ..recordings import Recording
from ..recordings.templates import undone
from ..robots import arm_of, gripper_motion, replay  # pyright: ignore[reportMissingImports] - mapped from robots/
from ..robots.primitives import Limits  # pyright: ignore[reportMissingImports]
from ..robots.replan_episode import LEVEL, highest  # pyright: ignore[reportMissingImports]
from ..robots.replay import model_of, unwound  # pyright: ignore[reportMissingImports]
from ..robots.spline import Spline  # pyright: ignore[reportMissingImports]
from ..types import Trajectory
from .deceleration import Halt, moved
from .motion_parameters import PERIOD, TURNING, ArmCourse, Course, HandCourse, Span, between, rotation
from .result import PLANNED

NEAREST = 0.1  # s, between waypoints: nearer ones tremble
SAME = 1e-6  # s
STOP = 0.01  # s after the end, in which what still moves is stopped
BRIEF = 0.02  # s, of coming to rest: not worth a word
MOVING = 0.02  # m/s
STRAIGHT = 0.9999  # upward part of a plane's normal


def courses_of(
    cloth: Cloth, recording: Recording, waypoints: int, wait: float, acceleration: float, limits: Limits
) -> list[Course]:
    """Of every gripper that holds the cloth, from the first frame to the end of the motion and a wait.

    What is under way at the end comes to rest in the wait.

    Raises:
        InvalidInput: grippers of nothing, one that takes hold on the way, or waypoints that are too near each other.
        RecordingError: no motion for one of the cloth's grasps.
    """
    seen = episode(cloth, recording, RATE)
    every = replay(recording, names=seen.motion)
    begin = float(seen.times[0])
    names = [name for name in seen.motion if name in recording.grasps and _holds(every[name], begin)]
    if not names:
        expected = "a gripper that holds the cloth, whose motion to change"
        raise InvalidInput("recording", got="no grasp that is closed from the first frame on", expected=expected)
    end = min(float(every[name].t[-1]) for name in names)
    if end - begin < waypoints * NEAREST:
        got = f"{waypoints} of {max(end - begin, 0):.3g} s of motion after the first frame"
        remedy = "ask for fewer, or begin with a longer motion"
        raise InvalidInput("waypoints", got=got, expected=f"{NEAREST:g} s or more for each", remedy=remedy)
    arms = {n: arm_of(recording, n) for n in names if n in recording.joints and n in recording.robots}
    angles = {n: torch.as_tensor(unwound(arm, recording.joints[n].q)) for n, arm in arms.items()}
    paths = {n: every[n]._replace(pose=every[n].pose.double()) for n in names}
    halts: dict[str, Halt] = {}
    for n, path in paths.items():
        at = partial(between, path.t, angles[n]) if n in arms else moved(path, end)
        hardest = [acceleration] if n in arms else [limits.acceleration] * 3 + [TURNING.acceleration] * 3
        halts[n] = Halt.of(at, begin, end, wait, torch.tensor(hardest, dtype=torch.float64))
    span = Span(begin, end, waypoints, max(float(halt.taken.max()) for halt in halts.values()))
    knots = _knots([path.t for path in paths.values()], span, wait)
    recorded = knots.clamp(max=end)  # then all halt and wait, and what was recorded longer as well
    out: list[Course] = []
    for n, path in paths.items():
        closed = path.closed[last_knot(path.t, knots + SAME).clamp(min=0)]
        _check_hold(n, closed)
        beyond = halts[n].beyond(knots)
        if n in arms:
            q = between(path.t, angles[n], recorded) + beyond
            out.append(ArmCourse(n, knots, closed, span, halts[n], arms[n], q, acceleration))
        else:
            pose = interpolate(path, recorded)
            table = highest(recording.colliders, pose[:, :2, 3].numpy())
            lowest = min(table, float(pose[:, 2, 3].min()))
            pose[:, :3] = torch.cat(
                [rotation(beyond[:, 3:]) @ pose[:, :3, :3], pose[:, :3, 3:] + beyond[:, :3, None]], 2
            )
            out.append(HandCourse(n, knots, closed, span, halts[n], pose, limits, lowest))
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
        end, wait, needed = course.span.end, float(course.t[-1]) - course.span.end, float(course.halt.needed.max())
        if needed > BRIEF:
            known = f"{course.name}: the recorded motion is under way where it ends, at {end:.2f} s"
            if needed <= wait + SAME:
                out.append(f"{known}: it comes to rest in {needed:.2f} s more, of the wait")
            else:
                out.append(f"{known}, and cannot come to rest in a wait of {wait:.2f} s: wait {needed:.2f} s or longer")
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


def _holds(path: Trajectory, begin: float) -> bool:
    """Whether it is closed at ``begin`` [s] or later."""
    return bool(path.closed[last_knot(path.t, path.t.new_tensor([begin + SAME])).clamp(min=0) :].any())


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
    """[S] s: the span's ends, that of the wait, all recorded ones, and more where these are far apart."""
    ends = times[0].new_tensor([span.begin, span.end, span.end + wait])
    every = torch.cat([*times, ends]).double().unique()
    every = every[(every >= span.begin) & (every <= span.end + wait)]
    every = every[torch.cat([every.new_ones(1), every.diff()]) > SAME]
    return Spline(every, every[:, None], every[:, None]).finer(PERIOD)


def _detached(path: Trajectory) -> Trajectory:
    return path._replace(pose=path.pose.detach())
