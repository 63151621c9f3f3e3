"""The planning task of a model, an episode and a goal, with warnings about them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from torch import Tensor

from .._utils.resume import ResumableStore
from ..cloth import Cloth
from ..episodes.cloth_fingerprint import cloth_fingerprint_parts
from ..episodes.observed import require_cpu
from ..episodes.world import WorldModel
from ..errors import InvalidInput
from ..recordings import Recording
from ..recordings.consistency import check_recording
from ..robots.primitives import GripperLimits  # pyright: ignore[reportMissingImports] - mapped from robots/
from .clearance import build_clearance
from .episode_conversion import extract_motion_parameters, motion_warnings
from .forward_model import ForwardModel, exact_model
from .goal import Goal
from .motion_parameters import GripperMotionParameters
from .objective import build_objective
from .task import PlanningTask

MAX_UV_OFFSET_M = 1e-6  # two meshes whose pattern coordinates differ by less are one
MAX_WAIT_S = 60.0
MAX_GOAL_EXTENT_RATIO = 3.0  # of a goal's extent to the cloth's: a larger goal is not in metres
ClothModel = Cloth | WorldModel


@dataclass(frozen=True)
class PlanOptions:
    """Options of a motion plan; see ``plan``.

    Attributes:
        waypoints: number of waypoints of each gripper.
        wait: s, time after the motion until the cloth is compared with the goal.
        acceleration: rad/s^2, largest acceleration of any joint.
        limits: of a gripper without an arm, along each axis.
        clearance: m, smallest distance between arms, and between an arm and the table.
        dt: s, largest substep; None: the stable one.
    """

    waypoints: int
    wait: float
    acceleration: float
    limits: GripperLimits
    clearance: float
    dt: float | None


def build_problem(
    model: ClothModel | Sequence[ClothModel],
    recording: Recording,
    goal: Goal | Tensor,
    options: PlanOptions,
    journal: str | Path | None = None,
    resume: bool | None = None,
    adapt_motion: Callable[[GripperMotionParameters], GripperMotionParameters] = lambda motion: motion,
) -> tuple[PlanningTask, list[str]]:
    """Build the planning task.

    Args:
        model: the cloth model or models.
        recording: the episode to begin with.
        goal: where the cloth shall be.
        options: of the plan.
        journal: folder that keeps computed results.
        resume: continue from the journal; None: the journal must be empty.
        adapt_motion: changes the parametrisation of a gripper's motion.

    Returns:
        The task, and warnings in sentences.

    Raises:
        InvalidInput, RecordingError: as ``plan``.
    """
    check_recording(recording)
    _check_options(options)
    models = _as_models(model)
    target = goal if isinstance(goal, Goal) else Goal(goal)
    for each in models:
        build_objective(target, each.base.cloth.mesh)  # refuses a goal of another cloth before anything is simulated
    cloth = models[0].base.cloth
    motions = extract_motion_parameters(
        cloth, recording, int(options.waypoints), options.wait, options.acceleration, options.limits
    )
    motions = [adapt_motion(motion) for motion in motions]
    forward_models = [ForwardModel(each, recording, motions, options.dt) for each in models]
    warnings = [
        *motion_warnings(recording, motions),
        *_check_goal(target, forward_models[0]),
        *_numbering_warnings(target, recording, cloth),
    ]
    clearance, warning = build_clearance(recording, motions, target.points, options.clearance)
    store = None if journal is None else ResumableStore(journal, _identity(forward_models, target, motions), resume)
    return PlanningTask(forward_models, motions, target, clearance, store), [*warnings, *([warning] if warning else [])]


def _check_options(options: PlanOptions) -> None:
    if not 0 <= options.wait <= MAX_WAIT_S:
        raise InvalidInput("wait", got=options.wait, expected=f"seconds, 0 to {MAX_WAIT_S:g}")
    check_positive(waypoints=options.waypoints, acceleration=options.acceleration, clearance=options.clearance)
    check_positive(speed=options.limits.speed, gripper_acceleration=options.limits.acceleration)


def _as_models(model: ClothModel | Sequence[ClothModel]) -> list[WorldModel]:
    given = list(model) if isinstance(model, Sequence) else [model]
    if not given or not all(isinstance(m, Cloth | WorldModel) for m in given):
        got = "none" if not given else ", ".join(sorted({type(m).__name__ for m in given}))
        raise InvalidInput("model", got=got, expected="a Cloth or a diagnosis.WorldModel, or several")
    models = [m if isinstance(m, WorldModel) else exact_model(m) for m in given]
    for m in models:
        require_cpu(m.base.cloth)
    return models


def _identity(
    forward_models: Sequence[ForwardModel], goal: Goal, motions: Sequence[GripperMotionParameters]
) -> list[object]:
    """Everything but the waypoints that derivatives depend on."""
    of_models = [
        part for model in forward_models for part in (*cloth_fingerprint_parts(model.world.cloth), *model.identity())
    ]
    of_motions = [
        part for m in motions for part in (m.name, m.span, m.recorded_coordinates, m.trajectory(m.zero_waypoints).pose)
    ]
    return [*of_models, goal.points, goal.faces, goal.uv, goal.vertices, *of_motions]


def check_positive(**numbers: float) -> None:
    """Refuse numbers that are not finite and positive; counts must be whole as well.

    Raises:
        InvalidInput: names the first wrong one.
    """
    for name, value in numbers.items():
        whole = name in ("waypoints", "iterations")
        if not math.isfinite(value) or value <= 0 or (whole and value != int(value)):
            raise InvalidInput(name, got=value, expected="a whole number > 0" if whole else "a finite value > 0")


def _numbering_warnings(goal: Goal, recording: Recording, cloth: Cloth) -> list[str]:
    """Goals by vertex count on the cloth's own mesh, which may differ from the episode's where grips end."""
    uv, cloth_uv = recording.cloth.uv, cloth.mesh.uv
    if goal.vertices is None or uv is None or cloth_uv is None or uv.shape != cloth_uv.shape:
        return []
    offset = float(np.linalg.norm(cloth_uv - uv, axis=-1).max())
    if offset < MAX_UV_OFFSET_M:
        return []
    return [
        f"the goal's vertices are those of the cloth's own mesh, up to {1e3 * offset:.1f} mm from the episode's where "
        "grips end: for the episode's mesh, give vt or uv"
    ]


def _check_goal(goal: Goal, forward_model: ForwardModel) -> list[str]:
    """Refuse a goal in millimetres; warn about one that is far away."""
    x = forward_model.state.x
    size = float((goal.points.amax(0) - goal.points.amin(0)).norm())
    extent = forward_model.world.cloth.mesh.extent
    if size > MAX_GOAL_EXTENT_RATIO * extent:
        got = f"points over {size:.3g} m, of a cloth of {extent:.3g} m"
        raise InvalidInput("goal", got=got, expected="the cloth where it shall be, in metres")
    distance = float((goal.points.mean(0).to(x) - x.mean(0)).norm())
    if distance < MAX_GOAL_EXTENT_RATIO * extent:
        return []
    return [f"the goal is {distance:.2f} m from where the cloth is at first: are both in one world frame?"]
