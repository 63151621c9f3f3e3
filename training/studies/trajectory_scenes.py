"""Scenes of the trajectories study: a garment in two free grippers, a hidden goal, tests of chaos and of limits."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchcloth.cloth import Cloth
from torchcloth.losses import find_closest_points
from torchcloth.planning import Goal
from torchcloth.planning.constrained_step import BOUND_TOLERANCE, solve_constrained_step
from torchcloth.planning.episode_conversion import extract_motion_parameters
from torchcloth.planning.forward_model import ForwardModel, exact_model
from torchcloth.planning.motion_parameters import GripperMotionParameters
from torchcloth.planning.objective import build_objective
from torchcloth.planning.task import PlanningTask
from torchcloth.recordings import ClothInfo, Collider, GraspInfo, Recording
from torchcloth.robots import (  # pyright: ignore[reportMissingImports] - mapped from robots/
    DEFAULT_JOINT_ACCELERATION,
    to_gripper_motion,
)
from torchcloth.robots.primitives import GripperLimits  # pyright: ignore[reportMissingImports]
from torchcloth.types import Trajectory

from .manipulations.scenes import INITIAL_LAYER_DISTANCE_M, TABLE_FRICTION, Discretisation, Fabric, Manipulation
from .manipulations.scenes import Scene as Staged

WAYPOINT_SHIFT_STD_M, WAYPOINT_TURN_STD_RAD = 0.1, 0.2  # of the hidden motion, before limits
SHARED_CHANGE_FRACTION = 0.9  # of the hidden change, the same for both hands
MIN_GOAL_DISTANCE_M = 0.03  # of the recorded motion's end from the goal; a nearer goal is drawn again
MAX_GOAL_DRAWS = 20
GOAL_POINTS, GOAL_NOISE_M = 1500, 1e-3
WAIT_TIME_S = 0.3
HANGING_TIME_S = 1.5  # in which a hanging garment comes to rest before the motion
CHAOS_DISTURBANCE_M = 1e-4  # of each vertex of the first shape, root mean square
DENSE_CHECK_PERIOD_S = 1e-3
MIN_LIMIT_EXCESS = 0.01  # fraction of a limit by which a motion exceeds it, above which it is a violation


class Scene(NamedTuple):
    """A garment in the grippers, on one mesh.

    Attributes:
        cloth: the garment.
        recording: of the motion to begin with.
        courses: motion parameters of each gripper.
        run: forward model.
        rest: [V, 3] m, vertices in the garment's frame.
    """

    cloth: Cloth
    recording: Recording
    courses: list[GripperMotionParameters]
    run: ForwardModel
    rest: np.ndarray

    @property
    def recorded_motion(self) -> dict[str, Trajectory]:
        """The motion to begin with, by gripper."""
        return {course.name: course.trajectory(course.zero_waypoints) for course in self.courses}

    def task(self, goal: Goal) -> PlanningTask:
        """Return the planning task of a goal."""
        return PlanningTask([self.run], self.courses, goal, None, None)

    @torch.no_grad()
    def final_shape(self, motion: Mapping[str, Trajectory]) -> Tensor:
        """Return the garment [V, 3] m after a motion."""
        return self.run.simulate(motion)[-1]

    def distance(self, goal: Goal, motion: Mapping[str, Trajectory]) -> float:
        """Return the distance [m] from the goal after a motion."""
        return float(build_objective(goal, self.cloth.mesh).distance(self.final_shape(motion)))


def build_scene(garment: str, motion: str, fine: Discretisation, waypoints: int, fabric: Fabric | None = None) -> Scene:
    """Build a garment in the grippers, and the motion to begin with.

    Args:
        garment: one of ``STUDY_GARMENTS``.
        motion: name of the action.
        fine: mesh, contact grid and step.
        waypoints: of each gripper.
        fabric: values; None: the true ones.
    """
    staged = Staged(Manipulation(garment, 0, motion, "slow", "at the corners", "straight"), fine)
    cloth = staged.cloth(Fabric.true(garment) if fabric is None else fabric).requires_grad_(False)
    first = staged.mesh.vertices
    if staged.hangs:
        paths = {name: path._replace(pose=path.pose.double()) for name, path in staged.action.motion.items()}
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "settle. after")  # a coarse garment moves by fractions of a millimetre
            first = cloth.settle(cloth.rest_state(), paths, duration=HANGING_TIME_S).x.numpy()
    recording = Recording(
        cloth=ClothInfo(
            areal_density=float(cloth.areal_density.value),
            vertices=staged.rest,
            faces=staged.mesh.faces,
            uv=staged.mesh.pattern,
            initial_vertices=first,
        ),
        provenance="synthetic: torchcloth, same engine",
        grasps={name: GraspInfo(vertices=vertices) for name, vertices in staged.gripped_vertices.items()},
        grippers={name: to_gripper_motion(path) for name, path in staged.action.motion.items()},
        colliders={
            "table": Collider(
                np.array([0.0, 0.0, INITIAL_LAYER_DISTANCE_M / 2]), np.array([0.0, 0.0, 1.0]), TABLE_FRICTION
            )
        },
    )
    courses = extract_motion_parameters(
        cloth, recording, waypoints, WAIT_TIME_S, DEFAULT_JOINT_ACCELERATION, GripperLimits()
    )
    dt = None if fine.step == 1.0 else fine.step * cloth.stable_step()
    return Scene(cloth, recording, courses, ForwardModel(exact_model(cloth), recording, courses, dt), staged.rest)


def draw_hidden_change(scene: Scene, rng: np.random.Generator) -> Tensor:
    """Draw the waypoints [N] of a hidden motion within the limits; both hands move similarly."""
    blank = scene.task(Goal(torch.zeros(1, 3)))
    wanted = torch.as_tensor(rng.standard_normal((len(scene.courses), *scene.courses[0].zero_waypoints.shape)))
    scale = [WAYPOINT_SHIFT_STD_M] * 3 + [WAYPOINT_TURN_STD_RAD] * 3
    shared = SHARED_CHANGE_FRACTION
    wanted = (shared * wanted.mean(0) + (1 - shared) * wanted) * torch.tensor(scale)
    return project_to_limits(blank, wanted.flatten())


def project_to_limits(task: PlanningTask, wanted: Tensor) -> Tensor:
    """Return the unknowns [N] within the limits that are nearest to the wanted ones."""
    return solve_constrained_step(task.start, -wanted, torch.eye(len(wanted)).to(wanted), task.bounds)


def make_hidden_goal(scene: Scene, rng: np.random.Generator) -> Goal:
    """Simulate a hidden motion within the limits; return noisy points of the garment's surface as the goal."""
    recorded, blank = scene.recorded_motion, scene.task(Goal(torch.zeros(1, 3)))
    for _ in range(MAX_GOAL_DRAWS):
        x = scene.final_shape(blank.motion(draw_hidden_change(scene, rng)))
        noise = torch.as_tensor(GOAL_NOISE_M * rng.standard_normal((GOAL_POINTS, 3)))
        goal = Goal(sample_surface(x, scene.run.faces, GOAL_POINTS, rng) + noise)
        if scene.distance(goal, recorded) > MIN_GOAL_DISTANCE_M:
            break
    return goal


def sample_surface(x: Tensor, faces: Tensor, count: int, rng: np.random.Generator) -> Tensor:
    """Sample points [N, 3] m uniformly on the surface."""
    a, b, c = x[faces].unbind(1)
    area = torch.linalg.cross(b - a, c - a).norm(dim=1).numpy()
    face = rng.choice(len(faces), count, p=area / area.sum())
    weights = torch.as_tensor(rng.dirichlet(np.ones(3), count))
    return (weights[:, :, None] * x[faces[face]]).sum(1)


@torch.no_grad()
def measure_chaos(
    scene: Scene, motion: Mapping[str, Trajectory], rng: np.random.Generator, repetitions: int = 2
) -> float:
    """Return how far vertices end apart [m] if the first shape changes by ``CHAOS_DISTURBANCE_M``.

    This is the root mean square over vertices and repetitions.
    """
    first, final = scene.run.state, scene.final_shape(motion)
    squares = []
    try:
        for _ in range(repetitions):
            noise = CHAOS_DISTURBANCE_M / np.sqrt(3) * rng.standard_normal(first.x.shape)
            scene.run.state = first._replace(x=first.x + torch.as_tensor(noise).to(first.x))
            squares.append(float((scene.final_shape(motion) - final).square().sum(1).mean()))
    finally:
        scene.run.state = first
    return float(np.sqrt(np.mean(squares)))


def compare_meshes(coarse: Scene, fine: Scene, motion: Mapping[str, Trajectory]) -> float:
    """Return the root mean square distance [m] of the same material points of both meshes after a motion."""
    place = find_closest_points(torch.as_tensor(coarse.rest), torch.as_tensor(fine.rest), fine.run.faces)
    difference = place.interpolate(fine.final_shape(motion)) - coarse.final_shape(motion)
    return float(difference.square().sum(1).mean().sqrt())


def check_limits(task: PlanningTask, at: Tensor) -> tuple[int, float]:
    """Check a motion against all limits each ``DENSE_CHECK_PERIOD_S``, far finer than the searches do.

    Returns:
        The number of limits (of a coordinate of a gripper: position, velocity, acceleration) that are exceeded by more
        than ``MIN_LIMIT_EXCESS``, and the largest excess as a fraction of the limit.
    """
    violated, largest = set(), 0.0
    for course, waypoints in zip(task.motions, task.split_waypoints(at), strict=True):
        bounds = _check_densely(course).bounds()
        value = bounds.rows @ waypoints.flatten().to(bounds.rows)
        room = torch.where(value > 0, bounds.high, -bounds.low)
        excess = torch.where(value.abs() > room + BOUND_TOLERANCE, (value.abs() - room) / room.clamp(min=1e-3), 0.0)
        violated |= {bounds.names[i] for i in torch.nonzero(excess > MIN_LIMIT_EXCESS).flatten().tolist()}
        largest = max(largest, float(excess.max()))
    return len(violated), largest


def _check_densely(course: GripperMotionParameters) -> GripperMotionParameters:
    def times(span) -> Tensor:
        count = round((span.end - span.begin) / DENSE_CHECK_PERIOD_S) + 1
        return torch.linspace(span.begin, span.end, count, dtype=torch.float64)

    dense = type("DenseSpan", (type(course.span),), {"bound_check_times": property(times)})
    return replace(course, span=dense(*course.span))
