"""Known errors put into real recordings: does the diagnosis say what they are, and how large?

IRI swings with all errors of their own get later stamps, or other depths, or a camera that leans; so truth is exact.
What a model with air sees of that is the difference of its cells with and without, screened as residuals are. Then the
amplitude is fitted with and without, and the difference is what was put in. With ``--diagnose`` the plain swings are
diagnosed from vacuum, and the salted ones from the model that this gives, about all causes: nobody says what is new.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchcloth._utils.files import write_text
from torchcloth.diagnosis import Hypothesis, quadratic_warm_start, build_base_model, start_from_model, list_hypotheses, fit, screen, prepare_data
from torchcloth.diagnosis.data.binning import align_rows
from torchcloth.diagnosis.inference.fitting import ModelFit, assemble_fit
from torchcloth.diagnosis.inference.linearise import Linearisation
from torchcloth.diagnosis.run import EXTENDED_MODEL_FILE
from torchcloth.recordings import Camera, PointClouds, Recording
from torchcloth.recordings.consistency import merge_scene

from ..resumable import ResumableStudy
from .fabric_tables import table
from .measured import VARIABLE, find, swings
from .resumable_diagnosis import diagnosis_in

RUNS = ("range60_rep1", "range90_rep1", "range30_rep1", "range60_rep2")
SECONDS, FAST_SECONDS = 6.0, 4.0
DISTANCE = 1.3  # m, of the camera, which the data do not say; depths grow from there
OWN = "air.linear"  # what the swings lack first, by their own diagnosis
ASKED = ("obs.", "env.gravity_tilt")  # beginnings of the causes that are asked about
ITERATIONS = 4
PLAIN = "plain"


@dataclass(frozen=True)
class Salt:
    """One error of known size.

    Attributes:
        cause: the library's name; amplitude: by its sign.
        put: (points [R, 3], their times [R], camera's place [3], the cloth's middle [3]) -> (points, times).
    """

    cause: str
    amplitude: float
    unit: str
    put: Callable[..., tuple[np.ndarray, np.ndarray]]


def _later(xyz, t, eye, middle):
    return xyz, t + 0.02


def _deeper(xyz, t, eye, middle):
    return eye + 1.01 * (xyz - eye), t


def _leaning(xyz, t, eye, middle):
    angle = np.radians(1.0)
    turn = np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])
    return (xyz - middle) @ turn.T + middle, t


SALTS = {
    "stamps 20 ms late": Salt("obs.clock", -0.02, "s", _later),
    "depths 1 % too large": Salt("obs.depth_scale", 0.01, "-", _deeper),
    "camera leans by 1 degree": Salt("obs.rotation[x]", float(np.radians(1.0)), "rad", _leaning),
}


def add(parser: argparse.ArgumentParser) -> None:
    """Options."""
    parser.add_argument("--source", type=Path, metavar="DIR", help=f"folder of measured data (${VARIABLE})")
    parser.add_argument("--diagnose", action="store_true", help="and diagnose plain and salted swings: an hour")


def run(options: argparse.Namespace) -> None:
    """Compute what is missing, then print and write salting.json."""
    source = find(options.source) / swings.SOURCE
    study = ResumableStudy(options.out, {"study": "salting", "fast": options.fast, "source": str(source.resolve())})
    found = study.run({"all": partial(salted, source, options.fast)})["all"]
    if options.diagnose:
        labels = (PLAIN, *SALTS)
        answers = study.run({_file(label): partial(blind, source, label, options) for label in labels})
        found = {**found, "diagnosed": {label: answers[_file(label)] for label in labels}}
    path = write_text(options.out / "salting.json", json.dumps(found, indent=1, allow_nan=False) + "\n")
    show(found)
    print(f"result: {path}")


def salted(source: Path, fast: bool) -> dict[str, Any]:
    """What the diagnosis says of each salt."""
    plain = [_short(swings.recording(source, name), fast) for name in RUNS[: 2 if fast else 4]]
    model = build_base_model(merge_scene(plain))
    every = list_hypotheses(model, plain)
    own, asked = _named(every, OWN), [h for h in every if h.name.startswith(ASKED)]
    setting = prepare_data(model, plain)
    near, before = quadratic_warm_start(model, setting)
    base = fit(near.with_hypothesis(own, own.typical), setting, asked, before=before)
    out = {}
    for label, salt in SALTS.items():
        changed = prepare_data(model, [_with(r, salt) for r in plain])
        after = fit(base.model, changed, asked, 0, noise=base.noise)
        rows = screen(difference(base, after))
        h = _named(asked, salt.cause)
        sizes = [_fitted(base, s, h) for s in (setting, changed)]
        out[label] = {
            "truth": {"effect": salt.cause, "amplitude": salt.amplitude, "unit": salt.unit},
            "told": [{"effect": r.hypothesis.name, "amplitude": r.amplitude, "gain": r.chi2} for r in rows[:3]],
            "fitted": sizes[1][0] - sizes[0][0],
            "std": sizes[1][1],  # of either fit; of their difference it is less, they have their noise in common
        }
    return out


def blind(source: Path, label: str, options: argparse.Namespace) -> dict[str, Any]:
    """What a diagnosis of the plain swings says, or of salted ones from the model that the plain ones gave."""
    recordings = [_short(swings.recording(source, name), options.fast) for name in RUNS[: 2 if options.fast else 4]]
    model = None
    if label in SALTS:
        model, recordings = start_from_model(
            options.out / _file(PLAIN) / EXTENDED_MODEL_FILE, [_with(r, SALTS[label]) for r in recordings]
        )
    answer = diagnosis_in(options.out / _file(label), recordings, model)
    return {key: answer.content[key] for key in ("verdict", "causes", "given", "also_unexplained", "undecided")}


def _file(label: str) -> str:
    return "diagnosed-" + label.replace(" ", "-").replace("%", "percent")


def difference(plain: ModelFit, salted: ModelFit) -> ModelFit:
    """The change of the cells as residuals, with the slopes of the first."""
    cells, numerics = [], []
    for a, b, n in zip(plain.linearisation.bins, salted.linearisation.bins, plain.linearisation.mesh_differences, strict=True):
        both = torch.isin(a.key, b.key)
        study = a.select(both)
        cells.append(study._replace(value=align_rows(study.key, b.key, b.value) - study.value))
        numerics.append(torch.zeros_like(n[both]))
    evidence: Linearisation = replace(plain.linearisation, cells=cells, numerics=numerics)
    return assemble_fit(plain.model, evidence, plain.noise)


def _fitted(base: ModelFit, setting: Any, h: Hypothesis) -> tuple[float, float]:
    """(amplitude, standard error) of a cause beside the model."""
    found = fit(base.model.with_hypothesis(h), setting, (), ITERATIONS, noise=base.noise)
    return found.model.amplitudes[-1], float(found.covariance[-1, -1].sqrt())


def _named(found: Sequence[Hypothesis], name: str) -> Hypothesis:
    return next(h for h in found if h.name == name)


def _short(r: Recording, fast: bool) -> Recording:
    """The beginning, seen by a camera in front of the cloth."""
    points = r.require("points", by="the study")
    points = points.only(points.t - points.t[0] <= (FAST_SECONDS if fast else SECONDS))
    pose = np.eye(4)
    pose[:3, 3] = points.xyz.mean(0) - [0.0, DISTANCE, 0.0]
    camera = Camera(width=640, height=480, K=np.eye(3), T_world_camera=pose)
    return replace(r, points=points, markers=None, cameras={"front": camera})


def _with(r: Recording, salt: Salt) -> Recording:
    """The recording with an error; the camera is where it was said to be."""
    p: PointClouds = r.points  # type: ignore[assignment]
    eye, middle = r.cameras["front"].T_world_camera[:3, 3], r.cloth.initial_vertices.mean(0)  # type: ignore[union-attr]
    xyz, t = salt.put(p.xyz, p.t, eye, middle)
    return replace(r, points=PointClouds(t, xyz, p.counts))


def show(found: dict[str, Any]) -> None:
    """As a table."""
    from rich.console import Console
    from rich.markup import escape

    headings = ("put in", "as", "amplitude", "told first", "amplitude", "chi^2", "second", "chi^2", "fitted")
    filled = table("Known errors in real swings", *headings, left=2)
    for label, case in ((label, found[label]) for label in SALTS):
        truth, (first, second, *_) = case["truth"], case["told"]
        fitted = f"{case['fitted']:.4f} ± {case['std']:.4f} {truth['unit']}"
        told = (escape(first["effect"]), f"{first['amplitude']:.4f}", f"{first['gain']:.0f}")
        also = (escape(second["effect"]), f"{second['gain']:.0f}")
        filled.add_row(label, escape(truth["effect"]), f"{truth['amplitude']:.4f}", *told, *also, fitted)
    console = Console(highlight=False)
    console.width = max(console.width, 150)
    console.print(filled)
    if "diagnosed" in found:
        console.print(_blindly(found["diagnosed"]))


def _blindly(answers: dict[str, Any]) -> Any:
    from rich.markup import escape

    headings = ("swings", "verdict", "cause", "cannot be told from", "amplitude (95 %)", "truth")
    filled = table("Diagnosed, the salted ones from the model of the plain ones", *headings, left=4)
    for label, answer in answers.items():
        salt = SALTS.get(label)
        truth = "" if salt is None else f"{salt.cause} {salt.amplitude:.4f} {salt.unit}"
        given = [{"class": (), "rivals": (), **c, "effect": f"{c['effect']} (given)"} for c in answer["given"]]
        rows = list(map(_cause, [*given, *answer["causes"]])) or [("none", "", "")]
        for k, row in enumerate(rows):
            first = (label, answer["verdict"]) if k == 0 else ("", "")
            filled.add_row(*first, *map(escape, row), escape(truth) if k == 0 else "")
    return filled


def _cause(cause: dict[str, Any]) -> tuple[str, str, str]:
    """Its name, what cannot be told from it, how large."""
    others = {*cause["class"], *(r["effect"] for r in cause["rivals"])} - {cause["effect"]}
    low, high = cause["ci95"]
    return (
        cause["effect"],
        ", ".join(sorted(others)),
        f"{cause['amplitude']:.4f} ({low:.4f} to {high:.4f}) {cause['unit']}",
    )
