"""Motions for garments: gradients through the simulator compared with reinforcement learning, as in the DiffCP paper.

Two free grippers hold a garment, as in the paper. A hidden motion on a finer mesh defines the goal, which is given as
noisy points of the surface. ``tc.plan`` (Gauss-Newton, and Adam as in the paper) and Soft Actor-Critic search for a
motion to the goal within the same limits. Their motions are executed on the finer mesh.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchcloth import planning
from torchcloth.cloth import Cloth
from torchcloth.errors import InvalidInput
from torchcloth.planning import Goal
from torchcloth.planning.constrained_step import solve_constrained_step
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

from ..resumable import ResumableStudy, write_result
from .manipulations.console_tables import heading_table, mm, show
from .manipulations.scenes import INITIAL_LAYER_DISTANCE_M, TABLE_FRICTION, Discretisation, Fabric, Manipulation
from .manipulations.scenes import Scene as Staged
from .trajectory_figures import draw_curves

GARMENT_MOTIONS = (("dress", "drag"), ("trousers", "cover"), ("shirt", "cover"))
METHOD_NAMES = ("gauss-newton", "adam", "sac")
WAYPOINT_SHIFT_STD_M, WAYPOINT_TURN_STD_RAD = 0.25, 0.4  # of the hidden motion, before limits
GOAL_POINTS, GOAL_NOISE_M = 1500, 1e-3
WAIT_TIME_S = 0.3


@dataclass(frozen=True)
class Scale:
    """Size of the study.

    Attributes:
        triangles: approximate number for planning; the goal's mesh has 1.5 times as many.
        gap: distance of layers that touch [m] for planning; 0.9 of it for the goal.
        waypoints: of each gripper, equal to the number of actions of the learner.
        newton: iterations of Gauss-Newton.
        adam: iterations of Adam.
        sac: motions of Soft Actor-Critic.
    """

    triangles: int = 250
    gap: float = 0.05
    waypoints: int = 4
    newton: int = 10
    adam: int = 60
    sac: int = 300

    @property
    def coarse(self) -> Discretisation:
        """Discretisation that is used for planning."""
        return Discretisation(self.triangles, self.gap)

    @property
    def fine(self) -> Discretisation:
        """Discretisation of the goal, with another mesh and contact grid."""
        return Discretisation(round(1.5 * self.triangles), 0.9 * self.gap)


FAST_SCALE = Scale(triangles=150, waypoints=2, newton=2, adam=3, sac=12)


class Scene(NamedTuple):
    """A garment in the grippers, on one mesh.

    Attributes:
        cloth: the garment.
        recording: of the motion to begin with.
        courses: motion parameters of each gripper.
        run: forward model.
    """

    cloth: Cloth
    recording: Recording
    courses: list[GripperMotionParameters]
    run: ForwardModel


def add(parser: argparse.ArgumentParser) -> None:
    """Add the study's options."""
    names = [garment for garment, _ in GARMENT_MOTIONS]
    parser.add_argument(
        "--garments", nargs="+", choices=names, default=names, metavar="NAME", help="garments (default: all)"
    )
    parser.add_argument("--methods", nargs="+", choices=METHOD_NAMES, default=list(METHOD_NAMES), metavar="NAME")
    parser.add_argument("--sac", type=int, metavar="N", help="motions of the learner (default: 300)")


def run(options: argparse.Namespace) -> None:
    """Run each method on each garment; print a table, draw curves, write trajectories.json."""
    scale = FAST_SCALE if options.fast else Scale()
    if options.sac is not None:
        if options.sac < 1:
            raise InvalidInput("--sac", got=options.sac, expected="1 or more")
        scale = Scale(**(asdict(scale) | {"sac": options.sac}))
    study = ResumableStudy(options.out, {"study": "trajectories", **asdict(scale)})
    results = study.run(
        {
            f"{garment}-{method}": partial(run_method, scale, k, garment, motion, method)
            for k, (garment, motion) in enumerate(GARMENT_MOTIONS)
            for method in options.methods
            if garment in options.garments
        }
    )
    show(_table(results), TABLE_NOTE)
    write_result(options.out / "trajectories.json", "trajectories", results)
    print(f"picture: {draw_curves(results, options.out / 'trajectories.png')}")


def run_method(scale: Scale, number: int, garment: str, motion: str, method: str) -> dict[str, Any]:
    """Run one method on one garment."""
    torch.set_default_dtype(torch.float64)
    coarse, fine = (build_scene(garment, motion, mesh, scale.waypoints) for mesh in (scale.coarse, scale.fine))
    goal = make_hidden_goal(fine, np.random.default_rng([11, number]))
    began = time.perf_counter()
    moved, expected, history, more = find_motion(method, scale, coarse, goal)
    seconds = time.perf_counter() - began
    with torch.no_grad():
        first, done = (
            fine.run.simulate(m)[-1] for m in ({c.name: c.trajectory(c.zero_waypoints) for c in fine.courses}, moved)
        )

    def distance(x: Tensor) -> float:
        return float(build_objective(goal, fine.cloth.mesh).distance(x))

    return {
        "recorded": distance(first),
        "executed": distance(done),
        "expected": expected,
        "history": history,
        "seconds": seconds,
        **more,
    }


def find_motion(
    method: str, scale: Scale, scene: Scene, goal: Goal
) -> tuple[dict[str, Trajectory], float, list[float], dict[str, Any]]:
    """Return the motion, its distance [m], the distances of all motions tried, and further figures."""
    if method != "sac":
        plan = planning.plan(
            scene.cloth,
            scene.recording,
            goal,
            waypoints=scale.waypoints,
            iterations=scale.newton if method == "gauss-newton" else scale.adam,
            method=method,  # type: ignore[arg-type] - one of two words
            wait=WAIT_TIME_S,
        )
        return (
            plan.motion,
            plan.distance_after[0],
            plan.distance_history,
            {"ended": plan.stop_reason, "warnings": plan.warnings},
        )
    from ..rl import learn
    from ..rl.env import make_stepwise

    courses = [make_stepwise(c) for c in scene.courses]
    task = PlanningTask([scene.run], courses, goal, None, None)
    results = learn(task, scale.sac)
    return task.motion(results.best), min(results.history), results.history, {"policy": results.policy}


def build_scene(garment: str, motion: str, fine: Discretisation, waypoints: int) -> Scene:
    """Build a garment in the grippers, and the motion to begin with."""
    staged = Staged(Manipulation(garment, 0, motion, "slow", "at the corners", "straight"), fine)
    cloth = staged.cloth(Fabric.true(garment)).requires_grad_(False)
    recording = Recording(
        cloth=ClothInfo(
            areal_density=float(cloth.areal_density.value),
            vertices=staged.rest,
            faces=staged.mesh.faces,
            uv=staged.mesh.pattern,
            initial_vertices=staged.mesh.vertices,
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
    return Scene(cloth, recording, courses, ForwardModel(exact_model(cloth), recording, courses, None))


def make_hidden_goal(scene: Scene, rng: np.random.Generator) -> Goal:
    """Simulate a hidden motion within the limits; return noisy points of the garment's surface as the goal."""
    blank = PlanningTask([scene.run], scene.courses, Goal(torch.zeros(1, 3)), None, None)
    wanted = torch.as_tensor(rng.standard_normal((len(scene.courses), *blank.motions[0].zero_waypoints.shape)))
    scale = [WAYPOINT_SHIFT_STD_M] * 3 + [WAYPOINT_TURN_STD_RAD] * 3
    # Both hands move similarly.
    wanted = (0.7 * wanted.mean(0) + 0.3 * wanted) * torch.tensor(scale)
    at = solve_constrained_step(blank.start, -wanted.flatten(), torch.eye(len(blank.start)).to(wanted), blank.bounds)
    with torch.no_grad():
        x = scene.run.simulate(blank.motion(at))[-1]
    return Goal(
        sample_surface(x, scene.run.faces, GOAL_POINTS, rng)
        + torch.as_tensor(GOAL_NOISE_M * rng.standard_normal((GOAL_POINTS, 3)))
    )


def sample_surface(x: Tensor, faces: Tensor, count: int, rng: np.random.Generator) -> Tensor:
    """Sample points [N, 3] m uniformly on the surface."""
    a, b, c = x[faces].unbind(1)
    area = torch.linalg.cross(b - a, c - a).norm(dim=1).numpy()
    face = rng.choice(len(faces), count, p=area / area.sum())
    weights = torch.as_tensor(rng.dirichlet(np.ones(3), count))
    return (weights[:, :, None] * x[faces[face]]).sum(1)


TABLE_NOTE = (
    "distance: mean distance of the goal's points, with 1 mm of noise, from the garment at the end. expected: on the "
    "mesh for planning. executed: the same motion on the finer mesh of the goal. motions: simulated ones. The tangents "
    "of a Gauss-Newton iteration cost tens of motions, a gradient of Adam two to three (see s). All use one engine."
)


def _table(results: dict[str, Any]):
    title = "Distance from the goal [mm]"
    table = heading_table(
        title, "garment", "by", "as recorded", "expected", "executed", "motions", "half way after", "s"
    )
    for name, case in results.items():
        garment, _, method = name.partition("-")
        history: Sequence[float | None] = case["history"]  # None: the simulation was unstable
        half = next((k for k, d in enumerate(history, 1) if d is not None and d < 0.5 * case["recorded"]), None)
        cells = [mm(case[key]) for key in ("recorded", "expected", "executed")]
        counts = [str(len(history)), "–" if half is None else str(half), f"{case['seconds']:.0f}"]
        table.add_row(garment, method, *cells, *counts)
    return table
