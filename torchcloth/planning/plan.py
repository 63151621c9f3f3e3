"""Motion planning by gradients through cloth and arms."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from torch import Tensor

from ..errors import InvalidInput
from ..recordings import Recording
from ..robots import (  # pyright: ignore[reportMissingImports] - mapped from robots/ at installation
    DEFAULT_JOINT_ACCELERATION,
)
from ..robots.primitives import GripperLimits  # pyright: ignore[reportMissingImports]
from ..types import Trajectory
from .episode_conversion import build_planned_episode
from .goal import Goal
from .optimizers import ProgressCallback, adam, gauss_newton
from .problem import ClothModel, PlanOptions, build_problem, check_positive
from .result import MotionPlan

SEARCH_METHODS = ("gauss-newton", "adam")


def plan(
    model: ClothModel | Sequence[ClothModel],
    recording: Recording,
    goal: Goal | Tensor,
    *,
    waypoints: int = 4,
    iterations: int = 15,
    method: Literal["gauss-newton", "adam"] = "gauss-newton",
    rate: float = 0.003,
    wait: float = 0.3,
    acceleration: float = DEFAULT_JOINT_ACCELERATION,
    limits: GripperLimits = GripperLimits(),  # noqa: B008 - a tuple
    clearance: float = 0.02,
    dt: float | None = None,
    on_progress: ProgressCallback = lambda number, distance, best: None,
    journal: str | Path | None = None,
    resume: bool | None = None,
) -> MotionPlan:
    """Change the motion of an episode's grippers until the simulated cloth ends at the goal.

    A smooth curve through ``waypoints`` is added to the joint angles of each arm, or to the pose of a gripper without
    an arm. It starts at the first frame. The times at which grippers open and close do not change. The search descends
    the distance to the goal at the end by its gradient through cloth and kinematics.

    Every motion that is evaluated keeps the joints' limits of position, velocity and acceleration. Arms stay clear of
    each other, of the table and of themselves. Where the recorded motion exceeds a limit, its own value is the limit.

    Args:
        model: the cloth, or a model of a diagnosis (``diagnosis.load_model``), which may include errors of robot and
            observer. Of several models, e.g. samples of a posterior, the mean distance is minimised.
        recording: gives the first shape, the grasps, the arms and the motion to begin with.
        goal: where the cloth shall be after the motion and the wait, as the recording's observer would see it.
        waypoints: number of waypoints of each gripper.
        iterations: largest number of steps.
        method: "gauss-newton" minimises the mean square distance by tangents. "adam" minimises the distance by reverse
            mode, as the DiffCP paper does.
        rate: learning rate of Adam's first steps, for each waypoint of a joint [rad] or of a free gripper [m, rad].
        wait: s, time after the motion until the cloth is compared with the goal.
        acceleration: rad/s^2, largest acceleration of any joint; robot descriptions give none.
        limits: of a gripper without an arm, along each axis.
        clearance: m, smallest distance between arms, and between an arm and the table.
        dt: s, largest substep; None: the stable one.
        on_progress: called with (number of motions evaluated, distance of this one [m], best distance [m]).
        journal: folder that keeps computed results, so that a stopped search can resume.
        resume: continue from the journal; None: the journal must be empty.

    Returns:
        The planned motion and what is expected of it.

    Raises:
        InvalidInput: invalid arguments, a goal that does not fit this cloth, or as ``ResumableStore``.
        RecordingError: the episode has no motion for one of the cloth's grasps.
        SimulationDiverged: the simulation of the recorded motion diverges.
    """
    started = time.monotonic()
    if method not in SEARCH_METHODS:
        raise InvalidInput("method", got=repr(method), expected=f"one of {', '.join(SEARCH_METHODS)}")
    check_positive(iterations=iterations, rate=rate)
    iterations = int(iterations)
    options = PlanOptions(waypoints, wait, acceleration, limits, clearance, dt)
    task, warnings = build_problem(model, recording, goal, options, journal, resume)
    if method == "adam":
        result = adam(task, task.start, iterations, rate, on_progress)
    else:
        result = gauss_newton(task, task.start, iterations, on_progress)
    (distance_before, frames_before), (distance_after, frames) = (
        task.evaluate_models(at) for at in (task.start, result.best)
    )
    recorded, planned = task.motion(task.start), task.motion(result.best)
    gap = task.smallest_gap(result.best)
    return MotionPlan(
        recording=build_planned_episode(recording, task.motions, task.split_waypoints(result.best)),
        motion=planned,
        distance_before=distance_before,
        distance_after=distance_after,
        distance_history=result.history,
        times=task.forward_models[0].times,
        frames=frames,
        frames_before=frames_before,
        faces=task.forward_models[0].faces,
        path_change={name: _max_displacement(recorded[name], planned[name]) for name in planned},
        nearest_limit=task.bounds.nearest_limit(result.best),
        nearest_solids=(
            "" if gap is None or not gap.first else f"{gap.first} to {gap.second}, {1e3 * gap.distance:.0f} mm"
        ),
        stop_reason=result.stop_reason,
        seconds=time.monotonic() - started,
        warnings=warnings,
    )


def _max_displacement(first: Trajectory, second: Trajectory) -> float:
    """Largest distance [m] of two paths at the same time."""
    return float((second.pose[:, :3, 3] - first.pose[:, :3, 3]).norm(dim=-1).max())
