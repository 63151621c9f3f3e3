"""A motion after which the cloth lies at the goal, by gradients through cloth and arms."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from torch import Tensor

from ..errors import InvalidInput
from ..recordings import Recording
from ..robots import ACCELERATION  # pyright: ignore[reportMissingImports] - mapped from robots/ at installation
from ..robots.primitives import Limits  # pyright: ignore[reportMissingImports]
from ..types import Trajectory
from .episode_conversion import as_episode
from .goal import Goal
from .optimizers import OnLook, adam, gauss_newton
from .problem import Asked, Believed, check_positive, posed
from .result import MotionPlan

METHODS = ("gauss-newton", "adam")


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
    if method not in METHODS:
        raise InvalidInput("method", got=repr(method), expected=f"one of {', '.join(METHODS)}")
    check_positive(iterations=iterations, rate=rate)
    iterations = int(iterations)
    asked = Asked(waypoints, wait, acceleration, limits, clearance, dt)
    task, warnings = posed(model, recording, goal, asked, journal, resume)
    if method == "adam":
        found = adam(task, task.start, iterations, rate, on_progress)
    else:
        found = gauss_newton(task, task.start, iterations, on_progress)
    (before, frames_before), (after, frames) = task.each(task.start), task.each(found.best)
    first, last = task.motion(task.start), task.motion(found.best)
    gap = task.nearest(found.best)
    return MotionPlan(
        recording=as_episode(recording, task.courses, task.split(found.best)),
        motion=last,
        before=before,
        after=after,
        history=found.history,
        times=task.rehearsals[0].times,
        frames=frames,
        frames_before=frames_before,
        faces=task.rehearsals[0].faces,
        moved={name: _apart(first[name], last[name]) for name in last},
        limit=task.bounds.nearest(found.best),
        nearest="" if gap is None or not gap.first else f"{gap.first} to {gap.second}, {1e3 * gap.distance:.0f} mm",
        ended=found.ended,
        seconds=time.monotonic() - began,
        warnings=warnings,
    )


def _apart(first: Trajectory, last: Trajectory) -> float:
    """m, the greatest distance of two paths at one time."""
    return float((last.pose[:, :3, 3] - first.pose[:, :3, 3]).norm(dim=-1).max())
