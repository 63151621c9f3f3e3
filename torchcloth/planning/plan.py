"""A motion after which the cloth lies at the goal, by gradients through cloth and arms."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from torch import Tensor

from ..cloth import Cloth
from ..diagnosis.world import Model
from ..errors import InvalidInput
from ..identification.episodes import on_cpu
from ..identification.journal import Journal, facts_of
from ..recordings import Recording
from ..recordings.together import check_recording
from ..robots import ACCELERATION  # pyright: ignore[reportMissingImports] - mapped from robots/ at installation
from ..robots.primitives import Limits  # pyright: ignore[reportMissingImports]
from ..types import Trajectory
from .clearance import clearance_of
from .courses import Course
from .descent import OnLook, adam, gauss_newton
from .goal import Goal
from .rehearsal import Rehearsal, plain
from .result import MotionPlan
from .staging import as_episode, courses_of, doubts
from .task import Task

METHODS = ("gauss-newton", "adam")
LARGE = 3.0  # times the cloth's extent: no goal of it in metres
Believed = Cloth | Model


def plan(
    model: Believed | Sequence[Believed],
    recording: Recording,
    goal: Goal | Tensor,
    *,
    waypoints: int = 4,
    iterations: int = 15,
    method: Literal["gauss-newton", "adam"] = "gauss-newton",
    rate: float = 0.003,
    wait: float = 0.3,
    acceleration: float = ACCELERATION,
    limits: Limits = Limits(),  # noqa: B008 - a tuple
    clearance: float = 0.02,
    dt: float | None = None,
    on_progress: OnLook = lambda number, distance, best: None,
    journal: str | Path | None = None,
    resume: bool | None = None,
) -> MotionPlan:
    """Changes the motion of an episode's grippers until the simulated cloth ends at the goal.

    To the joint angles of each arm, or to the pose of a gripper without one, a smooth curve through ``waypoints`` is
    added, from the first frame on; when the grippers open and close stays. The distance from the goal at the end is
    descended by its gradient through cloth and kinematics. Every motion that is tried keeps the joints' limits of
    position, velocity and acceleration, and arms clear of each other, of the table and of themselves, or of what the
    recorded motion does where that is beyond them.

    Args:
        model: the cloth, or a model of a diagnosis (``diagnosis.load_model``), whose robot and observer may err;
            several, e.g. drawn from what a fit leaves open: the mean distance is descended.
        recording: where the cloth is, who holds it, which arms these are, and the motion to begin with.
        goal: where the cloth shall be after the motion and the wait, as the observer of the recording would see it.
        waypoints: of each gripper.
        iterations: at most so many steps.
        method: "gauss-newton": on the mean square distance, by tangents. "adam": on the distance, by reverse mode, as
            the DiffCP paper descends.
        rate: of Adam's first steps: of each waypoint of each joint [rad], or of a free gripper [m, rad].
        wait: s after the motion, until the cloth is compared with the goal.
        acceleration: rad/s^2, of any joint; robots name no limit of it.
        limits: of a gripper without an arm, along each axis.
        clearance: m, between arms, and between an arm and the table.
        dt: s, largest substep; None: the stable one.
        on_progress: called with (number of motions looked at, its distance [m], the best so far [m]).
        journal: folder that keeps what was computed, so that a search that was stopped can go on.
        resume: take up what the journal holds; None: there must be nothing.

    Raises:
        InvalidInput: arguments that give no search, a goal that is not of this cloth, or as ``Journal``.
        RecordingError: no motion for one of the cloth's grasps.
        SimulationDiverged: already under the recorded motion.
    """
    began = time.monotonic()
    check_recording(recording)
    if method not in METHODS:
        raise InvalidInput("method", got=repr(method), expected=f"one of {', '.join(METHODS)}")
    _check(waypoints=waypoints, iterations=iterations, rate=rate, acceleration=acceleration)
    _check(clearance=clearance, speed=limits.speed, hardest=limits.acceleration)
    if not (math.isfinite(wait) and wait >= 0):
        raise InvalidInput("wait", got=wait, expected="seconds, 0 or more")
    models = _models(model)
    aim = goal if isinstance(goal, Goal) else Goal(goal)
    courses = courses_of(models[0].base.cloth, recording, waypoints, wait, acceleration, limits)
    rehearsals = [Rehearsal(m, recording, courses, dt) for m in models]
    warnings = [*doubts(recording, courses), *_check_goal(aim, rehearsals[0])]
    judge, doubt = clearance_of(recording, courses, aim.points, clearance)
    kept = None if journal is None else Journal(journal, _problem(rehearsals, aim, courses), resume)
    task = Task(rehearsals, courses, aim, judge, kept)
    if method == "adam":
        found = adam(task, task.start, iterations, rate, on_progress)
    else:
        found = gauss_newton(task, task.start, iterations, on_progress)
    (before, frames_before), (after, frames) = task.each(task.start), task.each(found.best)
    first, last = task.motion(task.start), task.motion(found.best)
    gap = None if judge is None else judge.nearest(task.angles(found.best))[0]
    return MotionPlan(
        recording=as_episode(recording, courses, task.split(found.best)),
        motion=last,
        before=before,
        after=after,
        history=found.history,
        times=rehearsals[0].times,
        frames=frames,
        frames_before=frames_before,
        faces=rehearsals[0].faces,
        moved={name: _apart(first[name], last[name]) for name in last},
        limit=task.bounds.nearest(found.best),
        nearest="" if gap is None or not gap.first else f"{gap.first} to {gap.second}, {1e3 * gap.distance:.0f} mm",
        ended=found.ended,
        seconds=time.monotonic() - began,
        warnings=[*warnings, *([doubt] if doubt else [])],
    )


def _apart(first: Trajectory, last: Trajectory) -> float:
    """m, the greatest distance of two paths at one time."""
    return float((last.pose[:, :3, 3] - first.pose[:, :3, 3]).norm(dim=-1).max())


def _models(model: Believed | Sequence[Believed]) -> list[Model]:
    given = list(model) if isinstance(model, Sequence) else [model]
    if not given or not all(isinstance(m, Cloth | Model) for m in given):
        got = "none" if not given else ", ".join(sorted({type(m).__name__ for m in given}))
        raise InvalidInput("model", got=got, expected="a Cloth or a diagnosis.Model, or several")
    found = [m if isinstance(m, Model) else plain(m) for m in given]
    for m in found:
        on_cpu(m.base.cloth)
    return found


def _problem(rehearsals: Sequence[Rehearsal], goal: Goal, courses: Sequence[Course]) -> list[object]:
    """What slopes depend on beside the point."""
    own = [part for r in rehearsals for part in (*facts_of(r.world.cloth), *r.identity())]
    ways = [part for c in courses for part in (c.name, c.span, c.start, c.trajectory(c.nothing).pose)]
    return [*own, goal.points, goal.faces, *ways]


def _check(**numbers: float) -> None:
    for name, value in numbers.items():
        whole = name in ("waypoints", "iterations")
        if not math.isfinite(value) or value <= 0 or (whole and value != int(value)):
            raise InvalidInput(name, got=value, expected="a whole number > 0" if whole else "a finite value > 0")


def _check_goal(goal: Goal, run: Rehearsal) -> list[str]:
    """In millimetres it would be a thousand times as large; a doubt about one that is far away."""
    x = run.state.x
    size, own = float((goal.points.amax(0) - goal.points.amin(0)).norm()), run.world.cloth.mesh.extent
    if size > LARGE * own:
        got = f"points over {size:.3g} m, of a cloth of {own:.3g} m"
        raise InvalidInput("goal", got=got, expected="the cloth where it shall be, in metres")
    away = float((goal.points.mean(0).to(x) - x.mean(0)).norm())
    if away < LARGE * own:
        return []
    return [f"the goal is {away:.2f} m from where the cloth is at first: are both in one world?"]
