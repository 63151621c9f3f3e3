"""Planned motions executed in another engine: does the cloth end at the goal, and what does a fitted fabric gain?

MuJoCo moves a sheet along a hidden path; the last points of a depth camera are the goal. From another motion,
``torchcloth plan`` finds a path to the goal, with fitted values of the fabric and with those of a wrong data sheet.
MuJoCo executes both.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from torchcloth import planning
from torchcloth.identification import build_cloth, identify, load_fitted_cloth
from torchcloth.identification.result import IDENTIFICATION_FILE_NAME
from torchcloth.losses import chamfer_to_surface
from torchcloth.planning import Goal
from torchcloth.recordings import Recording
from torchcloth.robots import replay  # pyright: ignore[reportMissingImports] - mapped from robots/ at installation

from ..resumable import ResumableStudy, check_jobs, write_result
from ..validation.independent import motions
from ..validation.independent.effects import add_effect
from ..validation.independent.flex_sheet import sheet_mesh
from ..validation.independent.generate import make_recording
from ..validation.independent.scene import Scene as IndependentScene
from ..validation.independent.scene import simulate
from ..validation.independent.sensor import sample_points
from .manipulations.console_tables import heading_table, mm, show

FIT_CASE = "fit"
FIT_MOTIONS = ("stretch", "swing")  # to which the fabric is fitted
NOMINAL_FACTORS = {"membrane_stiffness": 3.0, "bending_stiffness": 0.4}  # nominal over true value
TRUE_DRAG_COEFFICIENT = 1.2
GOAL_SHIFT_M = 0.08  # largest shift of the hidden path's end along each axis
GOAL_TURN_RAD = 0.3  # largest turn of the hands about the vertical
PLAN_OPTIONS: dict[str, dict[str, Any]] = {
    "fitted": {},
    "data sheet": {},
    "adam": {"method": "adam", "iterations": 60},  # with the fitted values
}


@dataclass(frozen=True)
class Scale:
    """Size of the study.

    Attributes:
        motions: names.
        nodes: along each side of the true mesh.
        fit_nodes: along each side of the model's mesh.
        iterations: of Gauss-Newton in the plan.
    """

    motions: tuple[str, ...] = ("swing", "swing-fast", "turn", "lift", "drag")
    nodes: int = 25
    fit_nodes: int = 17
    iterations: int = 12


FAST_SCALE = Scale(motions=("swing-fast",), nodes=13, fit_nodes=9, iterations=5)


class Scene(NamedTuple):
    """A cloth of the other engine.

    Attributes:
        true: with the true values.
        stated: with the values of the data sheet.
    """

    true: Any
    stated: Any


def add(parser: argparse.ArgumentParser) -> None:
    """Add the study's options."""
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="cases at a time (default: 1)")


def run(options: argparse.Namespace) -> None:
    """Fit the fabric, compute the cases, print and write reach.json."""
    check_jobs(options.jobs)
    scale = FAST_SCALE if options.fast else Scale()
    study = ResumableStudy(options.out, {"study": "reach", **asdict(scale)})
    folder = options.out / FIT_CASE
    cases: dict[str, Callable[[], dict[str, Any]]] = {FIT_CASE: partial(fit_fabric, scale, folder)}
    results = study.run(cases)
    cases = {f"{k}-{name}": partial(plan_and_execute, scale, k, name, folder) for k, name in enumerate(scale.motions)}
    results |= study.run(cases, options.jobs)
    show(_table(results), TABLE_NOTE)
    write_result(options.out / "reach.json", "reach", results)


def build_scenes(scale: Scale) -> Scene:
    """Build a knit in air, with true values and with those of a wrong data sheet."""
    make = IndependentScene()
    true = replace(make, sheet=replace(make.sheet, nodes=(scale.nodes, scale.nodes)))
    stated = replace(
        true,
        sheet=replace(
            true.sheet, membrane_stiffness=NOMINAL_FACTORS["membrane_stiffness"] * true.sheet.membrane_stiffness
        ),
        plate=replace(true.plate, stiffness=NOMINAL_FACTORS["bending_stiffness"] * true.plate.stiffness),
    )
    return Scene(add_effect(true, "air.drag_n", TRUE_DRAG_COEFFICIENT, {}), stated)


def fit_fabric(scale: Scale, folder: Path) -> dict[str, Any]:
    """Fit the fabric to two motions."""
    torch.set_default_dtype(torch.float64)
    recordings = [_recorded(scale, name, k)[0] for k, name in enumerate(FIT_MOTIONS)]
    fit = identify(build_cloth(recordings[0]), recordings, nuisances=["grasp"], exact_bench=True)
    fit.save(folder)
    return {name: {"value": p.value, "std": p.std, "unit": p.unit} for name, p in fit.parameters.items()}


def plan_and_execute(scale: Scale, number: int, name: str, folder: Path) -> dict[str, Any]:
    """Plan and execute a motion to one goal; return distances as recorded, as planned and as executed."""
    torch.set_default_dtype(torch.float64)
    episode, motion, recorded_result = _recorded(scale, name, 10 + number)
    cloth = build_scenes(scale).true
    hidden_motion = _shift_end(motion, np.random.default_rng([7, number]))
    goal_result = simulate(cloth, hidden_motion)
    cloud = sample_points(cloth.sensor, cloth.sheet, hidden_motion.t, goal_result.x, np.random.default_rng([8, number]))
    goal = Goal(torch.as_tensor(cloud.frame(len(cloud) - 1)))
    faces = torch.as_tensor(sheet_mesh(cloth.sheet)[1])
    out: dict[str, Any] = {
        "noise": _from_goal(goal, goal_result.x[-1], faces),
        "recorded": _from_goal(goal, recorded_result.x[-1], faces)
        | {"vertices": _rms(recorded_result.x[-1], goal_result.x[-1])},
    }
    for label, how in PLAN_OPTIONS.items():
        model = (
            build_cloth(episode)
            if label == "data sheet"
            else load_fitted_cloth(folder / IDENTIFICATION_FILE_NAME, episode)[0]
        )
        began = time.perf_counter()
        results = planning.plan(model, episode, goal, **({"iterations": scale.iterations, "wait": 0.0} | how))
        executed = simulate(cloth, _planned_motion(motion, results.recording))
        out[label] = {
            "before": results.distance_before[0],
            "expected": results.distance_after[0],
            **_from_goal(goal, executed.x[-1], faces),
            "vertices": _rms(executed.x[-1], goal_result.x[-1]),
            "motions_tried": len(results.distance_history),
            "seconds": time.perf_counter() - began,
            "limit": results.nearest_limit,
        }
    return out


def _recorded(scale: Scale, name: str, seed: int) -> tuple[Recording, Any, Any]:
    """Return the recording, the motion and the simulated result of a motion by name."""
    cloth = build_scenes(scale)
    motion = motions.make_motion(name, cloth.true.sheet)
    result = simulate(cloth.true, motion)
    stated = make_recording(cloth.true, motion, result, name, seed, scale.fit_nodes, data_sheet_scene=cloth.stated)
    return replace(stated, air_density=cloth.true.air.density, truth=None), motion, result


def _shift_end(motion: Any, rng: np.random.Generator) -> Any:
    """Return the motion with another end: both hands are gradually shifted and turned about the vertical."""
    jerk = motions.minimum_jerk
    t = motion.t
    share = jerk(t, np.array([t[0] + 0.2, t[-1] - 0.2]), np.array([0.0, 1.0]))
    shift, angle = rng.uniform(-GOAL_SHIFT_M, GOAL_SHIFT_M, 3), rng.uniform(-GOAL_TURN_RAD, GOAL_TURN_RAD)
    shift[2] = abs(shift[2])  # up: a table may lie below
    middle = np.mean([pose[:, :3, 3] for pose in motion.pose.values()], axis=0)
    turn = motions.rotations_about_z(share * angle)
    pose = {}
    for name, entry in motion.pose.items():
        new = entry.copy()
        new[:, :3, :3] = turn @ entry[:, :3, :3]
        new[:, :3, 3] = middle + np.einsum("kab,kb->ka", turn, entry[:, :3, 3] - middle) + share[:, None] * shift
        pose[name] = new
    return replace(motion, pose=pose)


def _planned_motion(motion: Any, planned: Recording) -> Any:
    """Return the planned paths for the other engine."""
    paths = replay(planned)
    t = next(iter(paths.values())).t.numpy()
    return replace(motion, t=t, pose={name: paths[name].pose.numpy() for name in motion.pose})


def _from_goal(goal: Goal, x: np.ndarray, faces: torch.Tensor) -> dict[str, float]:
    return {"distance": float(chamfer_to_surface(goal.points, torch.as_tensor(x), faces))}


def _rms(x: np.ndarray, y: np.ndarray) -> float:
    return float(np.sqrt(np.square(x - y).sum(-1).mean()))


TABLE_NOTE = (
    "distance: of the goal's points, with sensor noise, from the cloth at the end (one-sided Chamfer). expected: in "
    "the simulation of the plan. executed: in MuJoCo. vertices: root mean square distance of all vertices from their "
    "places after the hidden path."
)


def _table(results: dict[str, Any]):
    title = "Distance from the goal [mm]"
    table = heading_table(title, "motion", "planned with", "expected", "executed", "vertices", "motions tried")
    for name, case in results.items():
        if name == FIT_CASE:
            continue
        first = case["recorded"]
        table.add_row(name, "– (as recorded)", "", mm(first["distance"]), mm(first["vertices"]), "")
        for label in PLAN_OPTIONS:
            entry = case[label]
            cells = [mm(entry[key]) for key in ("expected", "distance", "vertices")]
            stated = "fitted, by Adam" if label == "adam" else label
            table.add_row("", stated, *cells, str(entry["motions_tried"]))
        table.add_row(
            "", "the hidden path itself", "", mm(case["noise"]["distance"]), mm(0.0), "", "", end_section=True
        )
    return table
