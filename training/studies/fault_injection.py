"""Known errors are injected into real recordings: does the diagnosis find their kind and size?

IRI swings get delayed stamps, scaled depths or a tilted camera, so the truth is known exactly. A model with air is
compared with the recordings with and without the error; the difference of the residuals is screened. Then the
amplitude is fitted with and without the error, and the difference of both is compared with the truth. With
``--diagnose``, unchanged swings are diagnosed from vacuum. The swings with an error are then diagnosed from the
resulting model, with all hypotheses and without a hint at the error.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchcloth.diagnosis import (
    Hypothesis,
    build_base_model,
    fit,
    list_hypotheses,
    prepare_data,
    quadratic_warm_start,
    screen,
    start_from_model,
)
from torchcloth.diagnosis.data.binning import align_rows
from torchcloth.diagnosis.inference.fitting import ModelFit, assemble_fit
from torchcloth.diagnosis.inference.linearise import Linearisation
from torchcloth.diagnosis.run import EXTENDED_MODEL_FILE
from torchcloth.recordings import Camera, PointClouds, Recording
from torchcloth.recordings.consistency import merge_scene

from ..resumable import ResumableStudy, write_result
from .fabric_tables import make_table
from .measured import DATA_VARIABLE, find_data_folder, swings
from .resumable_diagnosis import diagnosis_in

SWING_RUNS = ("range60_rep1", "range90_rep1", "range30_rep1", "range60_rep2")
EPISODE_S, FAST_INJECTION_EPISODE_S = 6.0, 4.0
CAMERA_DISTANCE_M = 1.3  # assumed, because the data do not contain it; depths are scaled from there
BASE_CAUSE = "air.linear"  # named first by a diagnosis of the unchanged swings
HYPOTHESIS_PREFIXES = ("obs.", "env.gravity_tilt")  # of the tested hypotheses
FIT_ITERATIONS = 4
UNCHANGED = "plain"


@dataclass(frozen=True)
class Fault:
    """An error of known size.

    Attributes:
        cause: name of the hypothesis.
        amplitude: true amplitude, with the sign of the hypothesis.
        unit: of the amplitude.
        inject: (points [R, 3], times [R], camera position [3], centre of the cloth [3]) -> (points, times).
    """

    cause: str
    amplitude: float
    unit: str
    inject: Callable[..., tuple[np.ndarray, np.ndarray]]


def _delay_stamps(xyz, t, eye, middle):
    return xyz, t + 0.02


def _scale_depths(xyz, t, eye, middle):
    return eye + 1.01 * (xyz - eye), t


def _rotate_camera(xyz, t, eye, middle):
    angle = np.radians(1.0)
    turn = np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])
    return (xyz - middle) @ turn.T + middle, t


FAULTS = {
    "stamps 20 ms late": Fault("obs.clock", -0.02, "s", _delay_stamps),
    "depths 1 % too large": Fault("obs.depth_scale", 0.01, "-", _scale_depths),
    "camera leans by 1 degree": Fault("obs.rotation[x]", float(np.radians(1.0)), "rad", _rotate_camera),
}


def add(parser: argparse.ArgumentParser) -> None:
    """Add the study's options."""
    parser.add_argument("--source", type=Path, metavar="DIR", help=f"folder of measured data (${DATA_VARIABLE})")
    parser.add_argument(
        "--diagnose", action="store_true", help="also diagnose swings without and with errors, which takes an hour"
    )


def run(options: argparse.Namespace) -> None:
    """Compute the missing cases, then print and write fault_injection.json."""
    source = find_data_folder(options.source) / swings.SOURCE_NAME
    study = ResumableStudy(
        options.out, {"study": "fault_injection", "fast": options.fast, "source": str(source.resolve())}
    )
    result = study.run({"all": partial(diagnose_faults, source, options.fast)})["all"]
    if options.diagnose:
        labels = (UNCHANGED, *FAULTS)
        answers = study.run({_file(label): partial(diagnose_blindly, source, label, options) for label in labels})
        result = {**result, "diagnosed": {label: answers[_file(label)] for label in labels}}
    path = write_result(options.out / "fault_injection.json", "fault_injection", result)
    show(result)
    print(f"result: {path}")


def diagnose_faults(source: Path, fast: bool) -> dict[str, Any]:
    """Screen and fit each injected error."""
    plain = [_crop_start(swings.recording(source, name), fast) for name in SWING_RUNS[: 2 if fast else 4]]
    model = build_base_model(merge_scene(plain))
    every = list_hypotheses(model, plain)
    base_cause, hypotheses = (
        _find_hypothesis(every, BASE_CAUSE),
        [h for h in every if h.name.startswith(HYPOTHESIS_PREFIXES)],
    )
    setting = prepare_data(model, plain)
    near, before = quadratic_warm_start(model, setting)
    base = fit(near.with_hypothesis(base_cause, base_cause.typical), setting, hypotheses, before=before)
    out = {}
    for label, fault in FAULTS.items():
        changed = prepare_data(model, [_inject(r, fault) for r in plain])
        after = fit(base.model, changed, hypotheses, 0, noise=base.noise)
        rows = screen(difference(base, after))
        h = _find_hypothesis(hypotheses, fault.cause)
        sizes = [_fitted(base, s, h) for s in (setting, changed)]
        out[label] = {
            "truth": {"effect": fault.cause, "amplitude": fault.amplitude, "unit": fault.unit},
            "top_rows": [{"effect": r.hypothesis.name, "amplitude": r.amplitude, "gain": r.chi2} for r in rows[:3]],
            "fitted": sizes[1][0] - sizes[0][0],
            "std": sizes[1][1],  # of one fit; that of the difference is smaller, because the noise is common
        }
    return out


def diagnose_blindly(source: Path, label: str, options: argparse.Namespace) -> dict[str, Any]:
    """Diagnose the unchanged swings, or swings with an error from the model of the unchanged ones."""
    recordings = [
        _crop_start(swings.recording(source, name), options.fast) for name in SWING_RUNS[: 2 if options.fast else 4]
    ]
    model = None
    if label in FAULTS:
        model, recordings = start_from_model(
            options.out / _file(UNCHANGED) / EXTENDED_MODEL_FILE, [_inject(r, FAULTS[label]) for r in recordings]
        )
    answer = diagnosis_in(options.out / _file(label), recordings, model)
    keys = ("verdict", "causes", "initial_causes", "also_unexplained", "undecided")
    return {key: answer.content[key] for key in keys}


def _file(label: str) -> str:
    return "diagnosed-" + label.replace(" ", "-").replace("%", "percent")


def difference(plain: ModelFit, with_fault: ModelFit) -> ModelFit:
    """Return the change of the binned residuals as residuals, with the slopes of the first fit."""
    before, after = plain.linearisation, with_fault.linearisation
    bins, mesh_differences = [], []
    for a, b, n in zip(before.bins, after.bins, before.mesh_differences, strict=True):
        in_both = torch.isin(a.key, b.key)
        common = a.select(in_both)
        bins.append(common._replace(value=align_rows(common.key, b.key, b.value) - common.value))
        mesh_differences.append(torch.zeros_like(n[in_both]))
    linearisation: Linearisation = replace(before, bins=bins, mesh_differences=mesh_differences)
    return assemble_fit(plain.model, linearisation, plain.noise)


def _fitted(base: ModelFit, setting: Any, h: Hypothesis) -> tuple[float, float]:
    """Fit a cause in addition to the model; return its amplitude and standard error."""
    result = fit(base.model.with_hypothesis(h), setting, (), FIT_ITERATIONS, noise=base.noise)
    return result.model.amplitudes[-1], float(result.covariance[-1, -1].sqrt())


def _find_hypothesis(hypotheses: Sequence[Hypothesis], name: str) -> Hypothesis:
    return next(h for h in hypotheses if h.name == name)


def _crop_start(r: Recording, fast: bool) -> Recording:
    """Return the beginning of a recording, with a camera in front of the cloth."""
    points = r.require("points", by="the study")
    points = points.select(points.t - points.t[0] <= (FAST_INJECTION_EPISODE_S if fast else EPISODE_S))
    pose = np.eye(4)
    pose[:3, 3] = points.xyz.mean(0) - [0.0, CAMERA_DISTANCE_M, 0.0]
    camera = Camera(width=640, height=480, K=np.eye(3), T_world_camera=pose)
    return replace(r, points=points, markers=None, cameras={"front": camera})


def _inject(r: Recording, fault: Fault) -> Recording:
    """Return the recording with an error; the stated camera pose does not change."""
    p: PointClouds = r.points  # type: ignore[assignment]
    eye, middle = r.cameras["front"].T_world_camera[:3, 3], r.cloth.initial_vertices.mean(0)  # type: ignore[union-attr]
    xyz, t = fault.inject(p.xyz, p.t, eye, middle)
    return replace(r, points=PointClouds(t, xyz, p.counts))


def show(result: dict[str, Any]) -> None:
    """Print the tables of the study."""
    from rich.console import Console
    from rich.markup import escape

    headings = (
        "injected error",
        "cause",
        "amplitude",
        "named first",
        "amplitude",
        "chi^2",
        "second",
        "chi^2",
        "fitted",
    )
    rows_table = make_table("Known errors in real swings", *headings, left=2)
    for label, case in ((label, result[label]) for label in FAULTS):
        truth, (first, second, *_) = case["truth"], case["top_rows"]
        fitted = f"{case['fitted']:.4f} ± {case['std']:.4f} {truth['unit']}"
        first_cells = (escape(first["effect"]), f"{first['amplitude']:.4f}", f"{first['gain']:.0f}")
        second_cells = (escape(second["effect"]), f"{second['gain']:.0f}")
        rows_table.add_row(
            label, escape(truth["effect"]), f"{truth['amplitude']:.4f}", *first_cells, *second_cells, fitted
        )
    console = Console(highlight=False)
    console.width = max(console.width, 150)
    console.print(rows_table)
    if "diagnosed" in result:
        console.print(_blind_table(result["diagnosed"]))


def _blind_table(answers: dict[str, Any]) -> Any:
    from rich.markup import escape

    headings = ("swings", "verdict", "cause", "confounded with", "amplitude (95 %)", "truth")
    rows_table = make_table("Diagnosed, with an error from the model without", *headings, left=4)
    for label, answer in answers.items():
        fault = FAULTS.get(label)
        truth = "" if fault is None else f"{fault.cause} {fault.amplitude:.4f} {fault.unit}"
        alone = {"equivalence_class": (), "rivals": ()}
        initial = [{**alone, **c, "effect": f"{c['effect']} (given)"} for c in answer["initial_causes"]]
        rows = list(map(_cause, [*initial, *answer["causes"]])) or [("none", "", "")]
        for k, row in enumerate(rows):
            first = (label, answer["verdict"]) if k == 0 else ("", "")
            rows_table.add_row(*first, *map(escape, row), escape(truth) if k == 0 else "")
    return rows_table


def _cause(cause: dict[str, Any]) -> tuple[str, str, str]:
    """Return a cause's name, the causes confounded with it, and its amplitude."""
    others = {*cause["equivalence_class"], *(r["effect"] for r in cause["rivals"])} - {cause["effect"]}
    low, high = cause["ci95"]
    return (
        cause["effect"],
        ", ".join(sorted(others)),
        f"{cause['amplitude']:.4f} ({low:.4f} to {high:.4f}) {cause['unit']}",
    )
