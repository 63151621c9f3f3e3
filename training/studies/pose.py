"""Pose estimation: the full mesh from partly hidden, noisy clouds, against another engine's truth.

MuJoCo moves a knitted sheet of 0.3 m, with air drag; a third of it is hidden behind something that passes, points carry
noise and a slowly varying bias as a Kinect's do. The truth is read only to score. Beside the estimate: what one has
without it.
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
from torchcloth._utils.files import write_text
from torchcloth.effects import AirDrag, Bending, Gravity
from torchcloth.errors import InvalidInput
from torchcloth.pose import PoseEstimate, estimate_pose
from torchcloth.pose.visibility import find_seen_vertices
from torchcloth.recordings import Recording, read

from ..resumable import ResumableStudy
from ..validation.independent.flex_sheet import SheetSpec, interpolate_bilinear
from .geometric_baselines import registered, snapped

DRAG = 1.2  # of the truth; its membrane has the data sheet's value
HIDDEN = ["air.drag_n=1.2", "obs.occlusion=0.3", "obs.bias=0.0007"]
REACH = 0.03  # m, of the snapping
PICTURE = ("swing-fast", "known to a factor of 2")
Uncertain = dict[str, tuple[float, float]]


class Setting(NamedTuple):
    """How much is done."""

    motions: tuple[str, ...] = ("swing-fast", "shake")
    nodes: int = 17  # along the truth's sides
    fit: int = 9  # along those of the estimate's mesh
    modes: int = 8
    window: float = 0.15
    models: tuple[str, ...] = ("true values", "identified", "wrong by 2, taken as exact", "known to a factor of 2")


FAST = Setting(("swing-fast",), 13, 7, 4, 0.3, ("true values", "wrong by 2, taken as exact"))


def add(parser: argparse.ArgumentParser) -> None:
    """Nothing but what every study has."""


def run(options: argparse.Namespace) -> None:
    """Every motion with every model; a table, and a picture."""
    setting = FAST if options.fast else Setting()
    study = ResumableStudy(options.out, {"study": "pose", **{key: _plain(value) for key, value in setting._asdict().items()}})
    study.start()
    cases: dict[str, Callable[[], dict[str, Any]]] = {}
    for motion in setting.motions:
        cases[f"{motion}, geometry"] = lambda motion=motion: _geometry(_scene(options.out, setting, motion))
        for model in setting.models:
            cases[f"{motion}, {model}"] = lambda motion=motion, model=model: _case(options.out, setting, motion, model)
    found = study.run(cases)
    rows = [row for name, case in found.items() for row in _rows(name, case)]
    _print(rows)
    write_text(options.out / "table.md", _markdown(rows))


def _plain(value: Any) -> Any:
    """As JSON gives it back."""
    return list(value) if isinstance(value, tuple) else value


class Scene(NamedTuple):
    """A recording, and where the mesh's vertices truly were."""

    recording: Recording
    truth: Tensor  # [T, V, 3] m
    hidden: Tensor  # [T, V] bool, no point near the true place


def _scene(out: Path, setting: Setting, motion: str) -> Scene:
    """Made by a process of its own, once."""
    path = out / "episodes" / motion
    if not path.is_dir():
        effects = [part for effect in HIDDEN for part in ("--effect", effect)]
        sizes = ["--nodes", str(setting.nodes), "--fit-nodes", str(setting.fit)]
        script = [sys.executable, "-m", "torchcloth.training.validation.independent.generate", "--motion", motion, "--seed", "1"]
        done = subprocess.run([*script, *sizes, *effects, "--out", str(path)], capture_output=True, text=True)
        if done.returncode:
            raise InvalidInput("validation.independent.generate", got=done.stderr.strip()[-300:])
    recording = read(path, with_truth=True)
    cloth = _cloth(recording)
    data = identification.build_episode(cloth, recording)
    truth = _at(recording, cloth, data.times.numpy())
    return Scene(recording, truth, ~find_seen_vertices(truth, data, cloth.mesh))


def _at(recording: Recording, cloth: tc.Cloth, times: np.ndarray) -> Tensor:
    """[T, V, 3] m, the truth at the vertices of a coarser mesh."""
    from scipy.interpolate import CubicSpline

    found = recording.require("truth", by="the study")
    side = round(len(found.vertices[0]) ** 0.5)
    width, height = np.ptp(np.asarray(cloth.mesh.uv), axis=0)
    spec = SheetSpec(width, height, nodes=(side, side))
    frames = CubicSpline(found.t, found.vertices)(times)
    return torch.as_tensor(np.stack([interpolate_bilinear(spec, x, cloth.mesh.uv)[0] for x in frames]))


def _cloth(recording: Recording, stiffness: float = 1.0, drag: float = DRAG) -> tc.Cloth:
    nominal = recording.cloth.nominal
    bending = Bending(nominal["bending_stiffness"], nominal["bending_damping_time"])
    effects = {"gravity": Gravity(recording.gravity.tolist()), "bending": bending, "air": AirDrag(drag)}
    cloth = identification.build_cloth(recording, effects=effects)
    _stiffness(cloth).set(stiffness * float(_stiffness(cloth).value.detach()))
    return cloth


def _stiffness(cloth: tc.Cloth) -> tc.PhysicalParameter:
    return cloth.get_submodule("material.youngs_modulus")  # type: ignore[return-value]


def _model(recording: Recording, name: str) -> tuple[tc.Cloth, Uncertain]:
    """The cloth, and what is said to be uncertain of it."""
    if name == "true values":
        return _cloth(recording), {}
    wrong = _cloth(recording, 0.5, 0.5 * DRAG)
    if name == "wrong by 2, taken as exact":
        return wrong, {}
    if name == "identified":
        return _identified(wrong, recording)
    stiffness = float(_stiffness(wrong).value.detach())
    return wrong, {"youngs_modulus": (stiffness, 2.0), "air.normal": (0.5 * DRAG, 0.5 * DRAG)}


def _identified(start: tc.Cloth, recording: Recording) -> tuple[tc.Cloth, Uncertain]:
    """The fit's values and errors, a factor of 2 where it calls them not identifiable: its search ended there.

    Drag that ended at nothing stays there.
    """
    fit = tc.identify(start, recording, ["youngs_modulus", "air.normal"])
    stiff, drag = fit.parameters["youngs_modulus"], fit.parameters["air.normal"]
    uncertain = {
        "youngs_modulus": (stiff.value, min(1 + stiff.std / stiff.value, 2.0)),
        "air.normal": (drag.value, min(drag.std, 0.5 * drag.value)),
    }
    nominal = float(_stiffness(_cloth(recording)).value.detach())
    return _cloth(recording, stiff.value / nominal, drag.value), {k: v for k, v in uncertain.items() if v[1] > 0}


def _geometry(scene: Scene) -> dict[str, Any]:
    """Without physics: carried, snapped, registered."""
    cloth = _cloth(scene.recording)
    data = identification.build_episode(cloth, scene.recording)
    held = torch.cat([part.index for part in cloth.boundaries.values()])  # type: ignore[misc]
    carried = identification.carry_rigidly(data)
    noise = scene.recording.observation_noise_std or 1e-3
    frames = {
        "carried rigidly": carried,
        "carried, snapped to the nearest points": snapped(carried, data, REACH),
        "registered frame by frame": registered(data, cloth.mesh, held, scene.truth[:, held], noise),
    }
    return {name: _errors(x, scene) for name, x in frames.items()}


def _case(out: Path, setting: Setting, motion: str, model: str) -> dict[str, Any]:
    """One estimate."""
    scene = _scene(out, setting, motion)
    cloth, uncertain = _model(scene.recording, model)
    found = estimate_pose(cloth, scene.recording, uncertain=uncertain, modes=setting.modes, window=setting.window)
    if (motion, model) == PICTURE:
        film = viewing.film_from_pose(scene.recording, found, truth=True)
        viewing.write_png(film, out / "pose.png", size=(520, 440))
    free = torch.ones(len(cloth.mesh.vertices), dtype=torch.bool)
    for part in cloth.boundaries.values():
        free[part.index] = False  # type: ignore[index]
    return {
        "simulated": _errors(found.uncorrected, scene),
        "estimated": _errors(found.x, scene) | _coverage(found, scene, free) | _figures(found),
    }


def _errors(x: Tensor, scene: Scene) -> dict[str, float]:
    """Root mean square distances from the truth [mm]."""
    squared = (x - scene.truth).square().sum(-1)
    return {"all": 1e3 * float(squared.mean().sqrt()), "hidden": 1e3 * float(squared[scene.hidden].mean().sqrt())}


def _coverage(found: PoseEstimate, scene: Scene, free: Tensor) -> dict[str, float]:
    inside = ((found.x - scene.truth).abs() < 1.96 * found.std).double()
    hidden = inside[scene.hidden & free]
    return {"coverage": float(inside[:, free].mean()), "coverage_hidden": float(hidden.mean())}


def _figures(found: PoseEstimate) -> dict[str, Any]:
    names = ("std_rms", "force_share", "seconds", "converged")
    return {**{name: found.fit[name] for name in names}, "warnings": found.warnings}


# -- what is printed --------------------------------------------------------------------------------------------------

HEADINGS = (
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
    for method, own in case.items():
        label = method if model == "geometry" else f"{method}: {model}"
        more = ("–",) * 4
        if "coverage" in own:
            shares = (_shown(own[key], 3) for key in ("coverage", "coverage_hidden"))
            more = (*shares, f"{1e3 * own['std_rms']:.2f}", f"{100 * own['force_share']:.1f} %")
        out.append((motion, label, f"{own['all']:.2f}", _shown(own["hidden"], 2), *more))
    return out


def _shown(value: float | None, digits: int) -> str:
    """A dash where nothing is hidden."""
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
    for k, heading in enumerate(HEADINGS):
        table.add_column(heading, justify="left" if k < 2 else "right", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    console.print(table)


def _markdown(rows: list[tuple[str, ...]]) -> str:
    lines = [HEADINGS, ("---", "---", *("---:",) * (len(HEADINGS) - 2)), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)
