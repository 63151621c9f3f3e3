"""From an episode to the courses of its grippers, and from planned courses to an episode."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from .._math import last_knot
from ..boundaries.motion import interpolate
from ..cloth import Cloth
from ..errors import InvalidInput, RecordingError
from ..identification.episodes import RATE, episode
from ..recordings import Recording
from ..robots import arm_of, gripper_motion, replay  # pyright: ignore[reportMissingImports] - mapped from robots/
from ..robots.primitives import Limits  # pyright: ignore[reportMissingImports]
from ..robots.replay import model_of  # pyright: ignore[reportMissingImports]
from ..types import Trajectory
from .courses import ArmCourse, Course, HandCourse, Span, highest_table, linear
from .result import PLANNED

SHORTEST = 0.1  # s, of a motion to which something can be added
SAME = 1e-6  # s


def courses_of(
    cloth: Cloth, recording: Recording, waypoints: int, wait: float, acceleration: float, limits: Limits
) -> list[Course]:
    """Of every gripper that holds the cloth, from the first frame to the end of the motion and a wait.

    Raises:
        InvalidInput: a motion that is too short, or grippers of nothing.
        RecordingError: no motion for one of the cloth's grasps.
    """
    seen = episode(cloth, recording, RATE)
    every = replay(recording)
    names = [name for name in seen.motion if name in recording.grasps]
    if not names:
        raise InvalidInput(
            "recording", got="no grasp", expected="a gripper that holds the cloth, whose motion to change"
        )
    begin = float(seen.times[0])
    end = min(float(every[name].t[-1]) for name in names)
    if end - begin < SHORTEST:
        got = f"{end - begin:.3g} s of motion after the first frame"
        raise RecordingError("motion", got=got, expected=f"{SHORTEST:g} s or more, all of it")
    span = Span(begin, end, waypoints)
    knots = _knots([every[name].t for name in names], span, wait)
    out: list[Course] = []
    for name in names:
        path = every[name]
        closed = path.closed[last_knot(path.t, knots).clamp(min=0)]
        if name in recording.joints and name in recording.robots:
            q = linear(path.t, torch.as_tensor(recording.joints[name].q), knots)
            out.append(ArmCourse(name, knots, closed, span, arm_of(recording, name), q, acceleration))
        else:
            pose = interpolate(path, knots.clamp(max=float(path.t[-1])))
            table = highest_table(recording.colliders, pose[:, :3, 3])
            lowest = min(table, float(pose[:, 2, 3].min()))
            out.append(HandCourse(name, knots, closed, span, pose, limits, lowest))
    return out


def as_episode(recording: Recording, courses: Sequence[Course], waypoints: Sequence[Tensor]) -> Recording:
    """The episode with the planned motions in it, and nothing that was seen or felt."""
    planned = list(zip(courses, waypoints, strict=True))
    grippers = {c.name: gripper_motion(_detached(c.trajectory(z))) for c, z in planned}
    joints = {c.name: c.joints(z) for c, z in planned if isinstance(c, ArmCourse)}
    robots = {name: replace(robot, model=model_of(recording, name)) for name, robot in recording.robots.items()}
    return replace(
        recording,
        grippers={**recording.grippers, **grippers},
        joints={**recording.joints, **joints},
        robots=robots,
        cameras={name: replace(c, depth=None, color=None, mask=None) for name, c in recording.cameras.items()},
        points=None,
        markers=None,
        truth=None,
        clock_offset=0.0,
        split={**recording.split, "motion": "planned", "replicate_of": None},
        provenance=PLANNED,
        path=None,
    )


def held_until(path: Trajectory, last: float) -> Trajectory:
    """A path that stands still where it ends, until ``last`` [s] at least."""
    if float(path.t[-1]) >= last:
        return path
    t = torch.cat([path.t, path.t.new_tensor([last])])
    pose = torch.cat([path.pose, path.pose[-1:]])
    return Trajectory(t, pose, torch.cat([path.closed, path.closed[-1:]]))


def _knots(times: Sequence[Tensor], span: Span, wait: float) -> Tensor:
    """[S] s, all recorded ones within the span, its ends, and those of the wait."""
    every = torch.cat(list(times))
    inner = every[(every > span.begin + SAME) & (every < span.end - SAME)].unique()
    inner = inner[torch.cat([inner.new_ones(1), inner.diff()])[: len(inner)] > SAME]
    after = [span.end] if wait == 0 else [span.end, span.end + 0.5 * wait, span.end + wait]
    return torch.cat([inner.new_tensor([span.begin]), inner, inner.new_tensor(after)])


def _detached(path: Trajectory) -> Trajectory:
    return path._replace(pose=path.pose.detach())
