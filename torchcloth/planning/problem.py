"""What is sought, from a model, an episode and a goal, with what is doubtful about it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from torch import Tensor

from .._utils.resume import Journal
from ..cloth import Cloth
from ..episodes.cloth_facts import facts_of
from ..episodes.observed import on_cpu
from ..episodes.world import Model
from ..errors import InvalidInput
from ..recordings import Recording
from ..recordings.consistency import check_recording
from ..robots.primitives import Limits  # pyright: ignore[reportMissingImports] - mapped from robots/ at installation
from .clearance import clearance_of
from .episode_conversion import courses_of, doubts
from .forward_model import Rehearsal, plain
from .goal import Goal
from .motion_parameters import Course
from .objective import aim_at
from .task import Task

SAME = 1e-6  # m
LONGEST = 60.0  # s, of a wait
LARGE = 3.0  # times the cloth's extent: no goal of it in metres
Believed = Cloth | Model


class Asked(NamedTuple):
    """Of ``plan``, see there."""

    waypoints: int
    wait: float
    acceleration: float
    limits: Limits
    clearance: float
    dt: float | None


def posed(
    model: Believed | Sequence[Believed],
    recording: Recording,
    goal: Goal | Tensor,
    asked: Asked,
    journal: str | Path | None = None,
    resume: bool | None = None,
    course: Callable[[Course], Course] = lambda course: course,
) -> tuple[Task, list[str]]:
    """(what is sought, warnings); ``course`` changes what is added to a gripper's motion.

    Raises:
        InvalidInput, RecordingError: as ``plan``.
    """
    check_recording(recording)
    _check(asked)
    models = _models(model)
    wanted = goal if isinstance(goal, Goal) else Goal(goal)
    for m in models:
        aim_at(wanted, m.base.cloth.mesh)  # refuses what is not of this cloth before anything is simulated
    cloth = models[0].base.cloth
    courses = courses_of(cloth, recording, int(asked.waypoints), asked.wait, asked.acceleration, asked.limits)
    courses = [course(c) for c in courses]
    rehearsals = [Rehearsal(m, recording, courses, asked.dt) for m in models]
    warnings = [
        *doubts(recording, courses),
        *_check_goal(wanted, rehearsals[0]),
        *_renumbered(wanted, recording, cloth),
    ]
    judge, doubt = clearance_of(recording, courses, wanted.points, asked.clearance)
    kept = None if journal is None else Journal(journal, _problem(rehearsals, wanted, courses), resume)
    return Task(rehearsals, courses, wanted, judge, kept), [*warnings, *([doubt] if doubt else [])]


def _check(asked: Asked) -> None:
    if not 0 <= asked.wait <= LONGEST:
        raise InvalidInput("wait", got=asked.wait, expected=f"seconds, 0 to {LONGEST:g}")
    check_positive(waypoints=asked.waypoints, acceleration=asked.acceleration, clearance=asked.clearance)
    check_positive(speed=asked.limits.speed, hardest=asked.limits.acceleration)


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
    return [*own, goal.points, goal.faces, goal.uv, goal.vertices, *ways]


def check_positive(**numbers: float) -> None:
    """Numbers of which some count."""
    for name, value in numbers.items():
        whole = name in ("waypoints", "iterations")
        if not math.isfinite(value) or value <= 0 or (whole and value != int(value)):
            raise InvalidInput(name, got=value, expected="a whole number > 0" if whole else "a finite value > 0")


def _renumbered(goal: Goal, recording: Recording, cloth: Cloth) -> list[str]:
    """A doubt about pieces by vertex, of a mesh on which grips end elsewhere than on that of the episode."""
    own, moved = recording.cloth.uv, cloth.mesh.uv
    if goal.vertices is None or own is None or moved is None or own.shape != moved.shape:
        return []
    apart = float(np.linalg.norm(moved - own, axis=-1).max())
    if apart < SAME:
        return []
    return [
        f"pieces by vertex are those of the cloth's own mesh, up to {1e3 * apart:.1f} mm from the episode's where "
        "grips end: of the episode's mesh give its vt, or uv"
    ]


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
