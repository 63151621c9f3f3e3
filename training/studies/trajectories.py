"""Motions for garments: gradients through the simulator compared with SAC and CMA-ES, as in the DiffCP paper.

Two free grippers hold a garment, as in the paper. A hidden motion on a finer mesh defines the goal, which is given as
noisy points of the surface. Gauss-Newton and Adam (as ``tc.plan``), Soft Actor-Critic and CMA-ES search for a motion to
the goal within the same limits. The seed draws the hidden motion, the noise and the learner. CMA-ES has the CPU time of
Gauss-Newton, the learner ten times its simulated motions. All motions are carried out on the finer mesh and by MuJoCo.
"""

from __future__ import annotations

import argparse
import multiprocessing
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np
import torch

from torchcloth.errors import InvalidInput, SimulationDiverged
from torchcloth.planning import Goal

from ..resumable import ResumableStudy, check_jobs, write_result
from .manipulations.console_tables import heading_table, show
from .manipulations.scenes import CARRY, Discretisation, Fabric
from .trajectory_execution import execute_in_mujoco
from .trajectory_figures import draw_curves
from .trajectory_scenes import (
    GOAL_POINTS,
    Scene,
    build_scene,
    check_limits,
    compare_meshes,
    draw_hidden_change,
    make_hidden_goal,
    measure_chaos,
    sample_surface,
)
from .trajectory_searches import (
    SearchOutcome,
    search_by_adam,
    search_by_cmaes,
    search_by_gauss_newton,
    search_by_sac,
)
from .trajectory_tables import build_chaos_table, build_summary_table

__all__ = ["GOAL_POINTS", "build_scene", "make_hidden_goal", "sample_surface"]

GARMENT_MOTIONS = (("dress", CARRY), ("trousers", CARRY), ("shirt", CARRY))
CHAOTIC_MOTIONS = (("dress", "cover"), ("shirt", "cover"))  # one seed each: what the methods do where nothing holds
CHAOS_ACTIONS = (CARRY, "drag", "cover", "fling")
FIRST_METHOD = "gauss-newton"  # the others' budgets follow from it
METHOD_NAMES = (FIRST_METHOD, "adam", "cma-es", "sac", "one-draw", "robust")
FABRIC_STD = 0.3  # of the logarithm of each fabric value, for plans that do not know the fabric
FABRIC_DRAWS = 4
SAC_MOTION_RATIO = 10  # of the learner's motions to Gauss-Newton's


@dataclass(frozen=True)
class Scale:
    """Size of the study.

    Attributes:
        triangles: approximate number for planning; the goal's mesh has 1.5 times as many.
        gap: distance of layers that touch [m] for planning; 0.9 of it for the goal.
        waypoints: of each gripper, equal to the number of actions of the learner.
        newton: iterations of Gauss-Newton.
        adam: iterations of Adam.
        sac: largest number of motions of Soft Actor-Critic.
    """

    triangles: int = 200
    gap: float = 0.1
    waypoints: int = 2
    newton: int = 6
    adam: int = 60
    sac: int = 5000

    @property
    def coarse(self) -> Discretisation:
        """Discretisation that is used for planning."""
        return Discretisation(self.triangles, self.gap)

    @property
    def fine(self) -> Discretisation:
        """Discretisation of the goal, with another mesh, contact grid and step."""
        return Discretisation(round(1.5 * self.triangles), 0.9 * self.gap, step=0.6)


FAST_SCALE = Scale(triangles=150, waypoints=2, newton=2, adam=3, sac=12)


def add(parser: argparse.ArgumentParser) -> None:
    """Add the study's options."""
    names = [garment for garment, _ in GARMENT_MOTIONS]
    parser.add_argument(
        "--garments", nargs="+", choices=names, default=names, metavar="NAME", help="garments (default: all)"
    )
    parser.add_argument("--methods", nargs="+", choices=METHOD_NAMES, default=list(METHOD_NAMES), metavar="NAME")
    parser.add_argument("--seeds", type=int, metavar="N", help="seeds of each garment (default: 5; with --fast 1)")
    parser.add_argument("--sac", type=int, metavar="N", help="most motions of the learner (default: 5000)")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="processes (default: 1)")


def run(options: argparse.Namespace) -> None:
    """Run each method on each garment and seed; print tables, draw curves, write trajectories.json."""
    scale = FAST_SCALE if options.fast else Scale()
    seeds = options.seeds if options.seeds is not None else 1 if options.fast else 5
    check_jobs(options.jobs)
    for name, number in {"--sac": options.sac, "--seeds": seeds}.items():
        if number is not None and number < 1:
            raise InvalidInput(name, got=number, expected="1 or more")
    if options.sac is not None:
        scale = Scale(**(asdict(scale) | {"sac": options.sac}))
    study = ResumableStudy(options.out, {"study": "trajectories", **asdict(scale)})
    pairs = [(g, a, seed) for seed in range(seeds) for g, a in GARMENT_MOTIONS if g in options.garments]
    if not options.fast:
        pairs += [(garment, action, 0) for garment, action in CHAOTIC_MOTIONS if garment in options.garments]
    first = {
        f"{g}-{action}-{seed}-{FIRST_METHOD}": partial(run_method, scale, g, action, seed, FIRST_METHOD, {})
        for g, action, seed in pairs
    }
    results = _run_cases(study, first, options.jobs)
    more = {
        f"{g}-{action}-{seed}-{method}": partial(
            run_method, scale, g, action, seed, method, results[f"{g}-{action}-{seed}-{FIRST_METHOD}"]
        )
        for g, action, seed in pairs
        for method in options.methods
        if method != FIRST_METHOD
    }
    actions = CHAOS_ACTIONS if not options.fast else (CARRY,)
    chaos = {
        f"chaos-{g}-{action}": partial(run_chaos, scale, g, action) for g in options.garments for action in actions
    }
    chaos = _run_cases(study, chaos, options.jobs)
    results |= _run_cases(study, more, options.jobs)
    show(build_summary_table(results), SUMMARY_NOTE)
    show(build_chaos_table(chaos), CHAOS_NOTE)
    show(_case_table(results), CASE_NOTE)
    write_result(options.out / "trajectories.json", "trajectories", {**results, **chaos})
    carried = {name: case for name, case in results.items() if case["action"] == CARRY}
    print(f"picture: {draw_curves(carried, options.out / 'trajectories.png')}")


def run_method(
    scale: Scale, garment: str, action: str, seed: int, method: str, first: Mapping[str, Any]
) -> dict[str, Any]:
    """Run one method on one garment and seed.

    Args:
        scale: size of the study.
        garment: name.
        action: motion to begin with.
        seed: of the hidden motion, the noise and the learner.
        method: one of ``METHOD_NAMES``.
        first: the case of Gauss-Newton, which sets the others' budgets.
    """
    torch.set_default_dtype(torch.float64)
    torch.set_num_threads(1)
    number = sum(map(ord, garment + action))
    coarse, fine = (build_scene(garment, action, mesh, scale.waypoints) for mesh in (scale.coarse, scale.fine))
    goal = make_hidden_goal(fine, np.random.default_rng([11, number, seed]))
    outcome = _search(scale, garment, action, seed, method, first, coarse, goal)
    motion = outcome.task.motion(outcome.best)
    violations, excess = check_limits(outcome.task, outcome.best)
    first_carried = action == CARRY and method == FIRST_METHOD
    return {
        "garment": garment,
        "action": action,
        "seed": seed,
        "method": method,
        "recorded_expected": coarse.distance(goal, coarse.recorded_motion),
        "recorded": fine.distance(goal, fine.recorded_motion),
        "expected": outcome.expected,
        "executed": _distance_or_none(fine, goal, motion),
        "mujoco_recorded": execute_in_mujoco(garment, fine, goal, fine.recorded_motion) if first_carried else None,
        "mujoco_executed": execute_in_mujoco(garment, fine, goal, motion) if action == CARRY else None,
        "history": [list(trial) for trial in outcome.history],
        "motions": outcome.history[-1].motions,
        "seconds": outcome.history[-1].seconds,
        "limit_violations": violations,
        "limit_excess": excess,
        "chaos": _chaos_or_none(coarse, motion, seed),
        "ended": outcome.ended,
    }


def run_chaos(scale: Scale, garment: str, action: str) -> dict[str, Any]:
    """Measure what a disturbance of 0.1 mm does, under the recorded motion and under hidden ones."""
    torch.set_default_dtype(torch.float64)
    torch.set_num_threads(1)
    coarse, fine = (build_scene(garment, action, mesh, scale.waypoints) for mesh in (scale.coarse, scale.fine))
    task, rng, recorded = coarse.task(Goal(torch.zeros(1, 3))), np.random.default_rng(5), coarse.recorded_motion
    first, moved, apart, meshes = coarse.final_shape(recorded), [], [], []
    for motion in [task.motion(draw_hidden_change(coarse, rng)) for _ in range(3)]:
        moved.append(float((coarse.final_shape(motion) - first).square().sum(1).mean().sqrt()))
        apart.append(measure_chaos(coarse, motion, rng))
        meshes.append(compare_meshes(coarse, fine, motion))
    return {
        "garment": garment,
        "action": action,
        "recorded": measure_chaos(coarse, recorded, rng),
        "hidden": apart,
        "meshes": meshes,
        "moved": moved,
    }


def _search(
    scale: Scale,
    garment: str,
    action: str,
    seed: int,
    method: str,
    first: Mapping[str, Any],
    scene: Scene,
    goal: Goal,
) -> SearchOutcome:
    if method == FIRST_METHOD:
        return search_by_gauss_newton([scene], goal, scale.newton)
    if method == "adam":
        return search_by_adam(scene, goal, scale.adam)
    if method == "cma-es":
        return search_by_cmaes(scene, goal, first["seconds"], seed)
    if method == "sac":
        return search_by_sac(scene, goal, min(scale.sac, SAC_MOTION_RATIO * first["motions"]), seed)
    rng = np.random.default_rng([13, seed])
    fabrics = [_draw_fabric(Fabric.true(garment), rng) for _ in range(FABRIC_DRAWS)]
    drawn = fabrics if method == "robust" else fabrics[:1]
    scenes = [build_scene(garment, action, scale.coarse, scale.waypoints, fabric) for fabric in drawn]
    return search_by_gauss_newton(scenes, goal, scale.newton)


def _draw_fabric(true: Fabric, rng: np.random.Generator) -> Fabric:
    """Draw a fabric around the true one; Poisson's ratio and contact stay."""
    factor = np.exp(FABRIC_STD * rng.standard_normal(3))
    return true._replace(
        youngs_modulus=true.youngs_modulus * float(factor[0]),
        bending=true.bending * float(factor[1]),
        air=true.air * float(factor[2]),
    )


def _distance_or_none(scene: Scene, goal: Goal, motion: Mapping[str, Any]) -> float | None:
    try:
        return scene.distance(goal, motion)
    except SimulationDiverged:
        return None


def _chaos_or_none(scene: Scene, motion: Mapping[str, Any], seed: int) -> float | None:
    try:
        return measure_chaos(scene, motion, np.random.default_rng([17, seed]))
    except SimulationDiverged:
        return None


def _run_cases(study: ResumableStudy, cases: Mapping[str, Callable[[], Any]], jobs: int) -> dict[str, dict[str, Any]]:
    """Return all cases; with several jobs each is computed in a process, because torch's settings are global."""
    if jobs == 1:
        return study.run(cases)
    with ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn")) as pool:

        def in_process(case: Callable[[], Any]) -> Callable[[], Any]:
            return lambda: pool.submit(case).result()

        return study.run({name: in_process(case) for name, case in cases.items()}, jobs)


SUMMARY_NOTE = (
    "Medians over the seeds, from least to most in brackets. recorded: distance of the goal's points, with 1 mm of "
    "noise, from the garment after the recorded motion on the finer mesh. expected: of the best motion on the mesh for "
    "planning. executed: the same motion on the finer mesh. MuJoCo: the same motion there. retained: fraction of the "
    "expected improvement that remains on the finer mesh. motions: a linearisation counts as one for each unknown, "
    "a reverse-mode gradient as three. violations: limits exceeded by more than 1 %, checked every 1 ms. worse: seeds "
    "in which Gauss-Newton ends below the method. one-draw and robust do not know the fabric: they plan for one draw, "
    "or for the mean of four, of values that are wrong by 30 % (standard deviation of the logarithm)."
)
CHAOS_NOTE = (
    "Root mean square distance of the vertices at the end after the first shape was disturbed by 0.1 mm: under the "
    "recorded motion, and under three hidden ones. meshes: distance of the same points of both meshes under the hidden "
    "motions. moved: by the hidden motions from where the recorded one ends."
)
CASE_NOTE = "Distances in mm. half way after: simulated motions until half the recorded distance."


def _case_table(results: Mapping[str, Any]):
    table = heading_table(
        "Each case", "case", "recorded", "expected", "executed", "MuJoCo", "motions", "half way after", "s", "chaos"
    )
    for name, case in results.items():
        half = [m for m, _, d in case["history"] if d is not None and d < 0.5 * case["recorded_expected"]]
        numbers = [case["recorded"], case["expected"], case["executed"], case.get("mujoco_executed")]
        cells = ["–" if x is None else f"{1e3 * x:.1f}" for x in numbers]
        last = "–" if case["chaos"] is None else f"{1e3 * case['chaos']:.1f}"
        table.add_row(name, *cells, str(case["motions"]), str(half[0]) if half else "–", f"{case['seconds']:.0f}", last)
    return table
