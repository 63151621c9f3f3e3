"""Motions for garments: descent through the simulator beside reinforcement learning, as in the DiffCP paper.

A garment lies in two grippers, which go where they are told, as in the paper. The goal is where another motion, which
nobody is told, brings it on a finer mesh; points of its surface with noise show it. ``tc.plan`` (Gauss-Newton, and Adam
as the paper descends) and Soft Actor-Critic look for a motion to there, within the same limits. What they find is
carried out on the finer mesh.
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
from torchcloth.robots import DEFAULT_JOINT_ACCELERATION, to_gripper_motion  # pyright: ignore[reportMissingImports] - mapped from robots/
from torchcloth.robots.primitives import GripperLimits  # pyright: ignore[reportMissingImports]
from torchcloth.types import Trajectory

from ..resumable import ResumableStudy
from .manipulations.console_tables import heading_table, mm, show, write
from .manipulations.scenes import TABLE_FRICTION, INITIAL_LAYER_DISTANCE_M, Discretisation, Fabric, Manipulation
from .manipulations.scenes import Scene as Staged
from .trajectory_figures import curves

CASES = (("dress", "drag"), ("trousers", "cover"), ("shirt", "cover"))
METHODS = ("gauss-newton", "adam", "sac")
AWAY, TURN = 0.25, 0.4  # m and rad, of the hidden motion's waypoints, before limits
POINTS, NOISE = 1500, 1e-3  # of the goal; m
WAIT = 0.3  # s


@dataclass(frozen=True)
class Scale:
    """How much is done.

    Attributes:
        triangles: of the mesh that is planned with, about; the goal's has half as many again.
        gap: m between layers that touch, likewise; 0.9 of it for the goal.
        waypoints: of each gripper; as many decisions has the learner.
        newton, adam: iterations; sac: motions.
    """

    triangles: int = 250
    gap: float = 0.05
    waypoints: int = 4
    newton: int = 10
    adam: int = 60
    sac: int = 300

    @property
    def coarse(self) -> Discretisation:
        """Of what is planned with."""
        return Discretisation(self.triangles, self.gap)

    @property
    def fine(self) -> Discretisation:
        """Of the goal, another mesh and contact grid."""
        return Discretisation(round(1.5 * self.triangles), 0.9 * self.gap)


FAST = Scale(triangles=150, waypoints=2, newton=2, adam=3, sac=12)


class Scene(NamedTuple):
    """A garment in the arms, on one mesh."""

    cloth: Cloth
    recording: Recording
    courses: list[GripperMotionParameters]
    run: ForwardModel


def add(parser: argparse.ArgumentParser) -> None:
    """Options."""
    names = [garment for garment, _ in CASES]
    parser.add_argument("--garments", nargs="+", choices=names, default=names, metavar="NAME", help="some of them")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS), metavar="NAME")
    parser.add_argument("--sac", type=int, metavar="N", help="motions that the learner tries (300)")


def run(options: argparse.Namespace) -> None:
    """Every method on every garment; tables, curves, trajectories.json."""
    scale = FAST if options.fast else Scale()
    if options.sac is not None:
        if options.sac < 1:
            raise InvalidInput("--sac", got=options.sac, expected="1 or more")
        scale = Scale(**(asdict(scale) | {"sac": options.sac}))
    study = ResumableStudy(options.out, {"study": "trajectories", **asdict(scale)})
    found = study.run(
        {
            f"{garment}-{method}": partial(sought, scale, k, garment, motion, method)
            for k, (garment, motion) in enumerate(CASES)
            for method in options.methods
            if garment in options.garments
        }
    )
    show(_table(found), NOTE)
    write(options.out / "trajectories.json", found)
    print(f"picture: {curves(found, options.out / 'trajectories.png')}")


def sought(scale: Scale, number: int, garment: str, motion: str, method: str) -> dict[str, Any]:
    """One method on one garment."""
    torch.set_default_dtype(torch.float64)
    coarse, fine = (set_up(garment, motion, mesh, scale.waypoints) for mesh in (scale.coarse, scale.fine))
    goal = hidden_goal(fine, np.random.default_rng([11, number]))
    began = time.perf_counter()
    moved, expected, history, more = found_by(method, scale, coarse, goal)
    seconds = time.perf_counter() - began
    with torch.no_grad():
        first, done = (fine.run.simulate(m)[-1] for m in ({c.name: c.trajectory(c.zero_waypoints) for c in fine.courses}, moved))
    distance = lambda x: float(build_objective(goal, fine.cloth.mesh).distance(x))  # noqa: E731
    return {
        "recorded": distance(first),
        "done": distance(done),
        "expected": expected,
        "history": history,
        "seconds": seconds,
        **more,
    }


def found_by(
    method: str, scale: Scale, scene: Scene, goal: Goal
) -> tuple[dict[str, Trajectory], float, list[float], dict[str, Any]]:
    """(motion, its distance [m], that of every one that was tried, what else is known)."""
    if method != "sac":
        plan = planning.plan(
            scene.cloth,
            scene.recording,
            goal,
            waypoints=scale.waypoints,
            iterations=scale.newton if method == "gauss-newton" else scale.adam,
            method=method,  # type: ignore[arg-type] - one of two words
            wait=WAIT,
        )
        return plan.motion, plan.distance_after[0], plan.distance_history, {"ended": plan.stop_reason, "warnings": plan.warnings}
    from ..rl import learn
    from ..rl.env import stepwise

    courses = [stepwise(c) for c in scene.courses]
    task = PlanningTask([scene.run], courses, goal, None, None)
    found = learn(task, scale.sac)
    return task.motion(found.best), min(found.history), found.history, {"policy": found.policy}


def set_up(garment: str, motion: str, fine: Discretisation, waypoints: int) -> Scene:
    """A garment where the grippers take hold of it, and the motion to begin with."""
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
        grasps={name: GraspInfo(vertices=held) for name, held in staged.held.items()},
        grippers={name: to_gripper_motion(path) for name, path in staged.action.motion.items()},
        colliders={"table": Collider(np.array([0.0, 0.0, INITIAL_LAYER_DISTANCE_M / 2]), np.array([0.0, 0.0, 1.0]), TABLE_FRICTION)},
    )
    courses = extract_motion_parameters(cloth, recording, waypoints, WAIT, DEFAULT_JOINT_ACCELERATION, GripperLimits())
    return Scene(cloth, recording, courses, ForwardModel(exact_model(cloth), recording, courses, None))


def hidden_goal(scene: Scene, rng: np.random.Generator) -> Goal:
    """Where another motion within the limits brings the garment, as noisy points of its surface."""
    blank = PlanningTask([scene.run], scene.courses, Goal(torch.zeros(1, 3)), None, None)
    wanted = torch.as_tensor(rng.standard_normal((len(scene.courses), *blank.motions[0].zero_waypoints.shape)))
    wanted = (0.7 * wanted.mean(0) + 0.3 * wanted) * torch.tensor([AWAY] * 3 + [TURN] * 3)  # hands go much alike
    at = solve_constrained_step(blank.start, -wanted.flatten(), torch.eye(len(blank.start)).to(wanted), blank.bounds)
    with torch.no_grad():
        x = scene.run.simulate(blank.motion(at))[-1]
    return Goal(on_surface(x, scene.run.faces, POINTS, rng) + torch.as_tensor(NOISE * rng.standard_normal((POINTS, 3))))


def on_surface(x: Tensor, faces: Tensor, count: int, rng: np.random.Generator) -> Tensor:
    """[N, 3] m, evenly over the surface."""
    a, b, c = x[faces].unbind(1)
    area = torch.linalg.cross(b - a, c - a).norm(dim=1).numpy()
    face = rng.choice(len(faces), count, p=area / area.sum())
    weights = torch.as_tensor(rng.dirichlet(np.ones(3), count))
    return (weights[:, :, None] * x[faces[face]]).sum(1)


NOTE = (
    "distance: mean distance of the goal's points, which have 1 mm of noise, from the garment at the end. expected: on "
    "the mesh that was planned with; done: the same motion on the goal's own finer mesh. motions: that were simulated; "
    "tangents of Gauss-Newton cost tens of motions each, gradients of Adam two to three (see s). One engine for all."
)


def _table(found: dict[str, Any]):
    title = "Distance from the goal [mm]"
    table = heading_table(title, "garment", "by", "as recorded", "expected", "done", "motions", "half way after", "s")
    for name, case in found.items():
        garment, _, method = name.partition("-")
        history: Sequence[float | None] = case["history"]  # None: could not be simulated
        half = next((k for k, d in enumerate(history, 1) if d is not None and d < 0.5 * case["recorded"]), None)
        cells = [mm(case[key]) for key in ("recorded", "expected", "done")]
        counts = [str(len(history)), "–" if half is None else str(half), f"{case['seconds']:.0f}"]
        table.add_row(garment, method, *cells, *counts)
    return table
