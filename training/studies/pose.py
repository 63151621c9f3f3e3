"""Pose estimation: the full mesh from partly hidden, noisy clouds, with truth from another engine.

MuJoCo moves a knitted sheet of 0.3 m with air drag. A passing object hides a third of it. Points have noise and a
slowly varying bias, as those of a Kinect. The truth is used for scoring only. The estimate is compared with baselines.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

import torchcloth as tc
from torchcloth import identification, viewing
from torchcloth._utils.constants import Z_95
from torchcloth._utils.files import write_text
from torchcloth.effects import AirDrag, Bending, Gravity
from torchcloth.errors import InvalidInput
from torchcloth.pose import PoseEstimate, estimate_pose
from torchcloth.pose.visibility import find_seen_vertices
from torchcloth.recordings import Recording, read

from ..resumable import ResumableStudy
from ..validation.independent.flex_sheet import SheetSpec, interpolate_bilinear
from .geometric_baselines import register_frames, snap_to_points

TRUE_DRAG_COEFFICIENT = 1.2  # the true membrane has the data sheet's value
GENERATOR_EFFECTS = ["air.drag_n=1.2", "obs.occlusion=0.3", "obs.bias=0.0007"]
SNAP_DISTANCE_M = 0.03
PICTURE_CASE = ("swing-fast", "known to a factor of 2")
Uncertain = dict[str, tuple[float, float]]


class Setting(NamedTuple):
    """Size of the study.

    Attributes:
        motions: names.
        nodes: along each side of the true mesh.
        fit: nodes along each side of the estimate's mesh.
        modes: of the corrective force.
        window: time over which the force is constant [s].
        models: which are used for the estimate.
    """

    motions: tuple[str, ...] = ("swing-fast", "shake")
    nodes: int = 17
    fit: int = 9
    modes: int = 8
    window: float = 0.15
    models: tuple[str, ...] = ("true values", "identified", "wrong by 2, taken as exact", "known to a factor of 2")


FAST_SETTING = Setting(("swing-fast",), 13, 7, 4, 0.3, ("true values", "wrong by 2, taken as exact"))


def add(parser: argparse.ArgumentParser) -> None:
    """Add no options besides those of every study."""


def run(options: argparse.Namespace) -> None:
    """Estimate each motion with each model; print a table and write a picture."""
    setting = FAST_SETTING if options.fast else Setting()
    study = ResumableStudy(
        options.out, {"study": "pose", **{key: _plain(value) for key, value in setting._asdict().items()}}
    )
    study.start()
    cases: dict[str, Callable[[], dict[str, Any]]] = {}
    for motion in setting.motions:
        cases[f"{motion}, geometry"] = lambda motion=motion: _geometry(_scene(options.out, setting, motion))
        for model in setting.models:
            cases[f"{motion}, {model}"] = lambda motion=motion, model=model: _case(options.out, setting, motion, model)
    result = study.run(cases)
    rows = [row for name, case in result.items() for row in _rows(name, case)]
    _print(rows)
    write_text(options.out / "table.md", _markdown(rows))


def _plain(value: Any) -> Any:
    """Return a value as JSON gives it back."""
    return list(value) if isinstance(value, tuple) else value


class Scene(NamedTuple):
    """A recording and the true vertices.

    Attributes:
        recording: data.
        truth: [T, V, 3] m.
        hidden: [T, V] bool, whether no point is near the true place.
    """

    recording: Recording
    truth: Tensor
    hidden: Tensor


def _scene(out: Path, setting: Setting, motion: str) -> Scene:
    """Generate the scene once, in a separate process."""
    path = out / "episodes" / motion
    if not path.is_dir():
        effects = [part for effect in GENERATOR_EFFECTS for part in ("--effect", effect)]
        sizes = ["--nodes", str(setting.nodes), "--fit-nodes", str(setting.fit)]
        script = [
            sys.executable,
            "-m",
            "torchcloth.training.validation.independent.generate",
            "--motion",
            motion,
            "--seed",
            "1",
        ]
        done = subprocess.run([*script, *sizes, *effects, "--out", str(path)], capture_output=True, text=True)
        if done.returncode:
            raise InvalidInput("validation.independent.generate", got=done.stderr.strip()[-300:])
    recording = read(path, with_truth=True)
    cloth = _cloth(recording)
    data = identification.build_episode(cloth, recording)
    truth = _at(recording, cloth, data.times.numpy())
    return Scene(recording, truth, ~find_seen_vertices(truth, data, cloth.mesh))


def _at(recording: Recording, cloth: tc.Cloth, times: np.ndarray) -> Tensor:
    """Return [T, V, 3] m, the truth at the vertices of a coarser mesh."""
    from scipy.interpolate import CubicSpline

    result = recording.require("truth", by="the study")
    assert cloth.mesh.uv is not None
    side = round(len(result.vertices[0]) ** 0.5)
    width, height = np.ptp(np.asarray(cloth.mesh.uv), axis=0)
    spec = SheetSpec(width, height, nodes=(side, side))
    frames = CubicSpline(result.t, result.vertices)(times)
    return torch.as_tensor(np.stack([interpolate_bilinear(spec, x, cloth.mesh.uv)[0] for x in frames]))


def _cloth(recording: Recording, stiffness: float = 1.0, drag: float = TRUE_DRAG_COEFFICIENT) -> tc.Cloth:
    nominal = recording.cloth.nominal
    bending = Bending(nominal["bending_stiffness"], nominal["bending_damping_time"])
    effects = {"gravity": Gravity(recording.gravity.tolist()), "bending": bending, "air": AirDrag(drag)}
    cloth = identification.build_cloth(recording, effects=effects)
    _stiffness(cloth).set(stiffness * float(_stiffness(cloth).value.detach()))
    return cloth


def _stiffness(cloth: tc.Cloth) -> tc.PhysicalParameter:
    return cloth.get_submodule("material.youngs_modulus")  # type: ignore[return-value]


def _model(recording: Recording, name: str) -> tuple[tc.Cloth, Uncertain]:
    """Return the cloth and its uncertain parameters."""
    if name == "true values":
        return _cloth(recording), {}
    wrong = _cloth(recording, 0.5, 0.5 * TRUE_DRAG_COEFFICIENT)
    if name == "wrong by 2, taken as exact":
        return wrong, {}
    if name == "identified":
        return _identified(wrong, recording)
    stiffness = float(_stiffness(wrong).value.detach())
    return wrong, {
        "youngs_modulus": (stiffness, 2.0),
        "air.normal": (0.5 * TRUE_DRAG_COEFFICIENT, 0.5 * TRUE_DRAG_COEFFICIENT),
    }


def _identified(start: tc.Cloth, recording: Recording) -> tuple[tc.Cloth, Uncertain]:
    """Return the cloth of a fit with its standard errors, at most a factor of 2.

    Drag that was fitted to zero has no uncertainty.
    """
    fit = tc.identify(start, recording, ["youngs_modulus", "air.normal"], exact_bench=True)
    stiff, drag = fit.parameters["youngs_modulus"], fit.parameters["air.normal"]
    uncertain = {
        "youngs_modulus": (stiff.value, min(1 + stiff.std / stiff.value, 2.0)),
        "air.normal": (drag.value, min(drag.std, 0.5 * drag.value)),
    }
    nominal = float(_stiffness(_cloth(recording)).value.detach())
    return _cloth(recording, stiff.value / nominal, drag.value), {k: v for k, v in uncertain.items() if v[1] > 0}


def _geometry(scene: Scene) -> dict[str, Any]:
    """Compute the baselines without physics."""
    cloth = _cloth(scene.recording)
    data = identification.build_episode(cloth, scene.recording)
    gripped = torch.cat([part.index for part in cloth.boundaries.values()])  # type: ignore[misc]
    carried = identification.carry_rigidly(data)
    noise = scene.recording.observation_noise_std or 1e-3
    frames = {
        "carried rigidly": carried,
        "carried, snapped to the nearest points": snap_to_points(carried, data, SNAP_DISTANCE_M),
        "registered frame by frame": register_frames(data, cloth.mesh, gripped, scene.truth[:, gripped], noise),
    }
    return {name: _errors(x, scene) for name, x in frames.items()}


def _case(out: Path, setting: Setting, motion: str, model: str) -> dict[str, Any]:
    """Compute one estimate and its errors."""
    scene = _scene(out, setting, motion)
    cloth, uncertain = _model(scene.recording, model)
    result = estimate_pose(cloth, scene.recording, uncertain=uncertain, modes=setting.modes, window=setting.window)
    if (motion, model) == PICTURE_CASE:
        film = viewing.film_from_pose(scene.recording, result, truth=True)
        viewing.write_png(film, out / "pose.png", size=(520, 440))
    free = torch.ones(len(cloth.mesh.vertices), dtype=torch.bool)
    for part in cloth.boundaries.values():
        free[part.index] = False  # type: ignore[index]
    return {
        "simulated": _errors(result.uncorrected, scene),
        "estimated": _errors(result.x, scene) | _coverage(result, scene, free) | _figures(result),
    }


def _errors(x: Tensor, scene: Scene) -> dict[str, float]:
    """Return root mean square distances from the truth [mm]."""
    squared = (x - scene.truth).square().sum(-1)
    return {"all": 1e3 * float(squared.mean().sqrt()), "hidden": 1e3 * float(squared[scene.hidden].mean().sqrt())}


def _coverage(result: PoseEstimate, scene: Scene, free: Tensor) -> dict[str, float]:
    inside = ((result.x - scene.truth).abs() < Z_95 * result.std).double()
    hidden = inside[scene.hidden & free]
    return {"coverage": float(inside[:, free].mean()), "coverage_hidden": float(hidden.mean())}


def _figures(result: PoseEstimate) -> dict[str, Any]:
    names = ("std_rms", "force_fraction", "seconds", "converged")
    return {**{name: result.fit[name] for name in names}, "warnings": result.warnings}


# -- what is printed --------------------------------------------------------------------------------------------------

TABLE_HEADINGS = (
    "motion",
    "method",
    "all, mm",
    "hidden, mm",
    "in 95 %",
    "hidden in 95 %",
    "std. error, mm",
    "force / weight",
)


def _rows(name: str, case: Mapping[str, Mapping[str, Any]]) -> list[tuple[str, ...]]:
    motion, model = name.split(", ", 1)
    out = []
    for method, values in case.items():
        label = method if model == "geometry" else f"{method}: {model}"
        coverage_cells = ("–",) * 4
        if "coverage" in values:
            shares = (_shown(values[key], 3) for key in ("coverage", "coverage_hidden"))
            coverage_cells = (*shares, f"{1e3 * values['std_rms']:.2f}", f"{100 * values['force_fraction']:.1f} %")
        out.append((motion, label, f"{values['all']:.2f}", _shown(values["hidden"], 2), *coverage_cells))
    return out


def _shown(value: float | None, digits: int) -> str:
    """Format a value; a dash if nothing is hidden."""
    return "–" if value is None else f"{value:.{digits}f}"


def _print(rows: list[tuple[str, ...]]) -> None:
    from rich import box
    from rich.console import Console
    from rich.table import Table

    console = Console(highlight=False)
    console.width = max(console.width, 140)
    table = Table(
        title="Distance from the truth, rms over vertices and frames", title_justify="left", box=box.SIMPLE_HEAD
    )
    for k, heading in enumerate(TABLE_HEADINGS):
        table.add_column(heading, justify="left" if k < 2 else "right", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    console.print(table)


def _markdown(rows: list[tuple[str, ...]]) -> str:
    lines = [TABLE_HEADINGS, ("---", "---", *("---:",) * (len(TABLE_HEADINGS) - 2)), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)
