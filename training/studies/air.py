"""Do real swings say that air is what vacuum lacks? Diagnoses of IRI swings, and what they mend of runs held out.

Groups of three swings of different sizes are diagnosed as ``torchcloth diagnose`` does, each from a base model in
vacuum and about all that the catalogue knows; their reports are kept. Then every group's model predicts whole runs
that none has seen, without its causes and with them: the distance of the nodes, and frequency and decay of the free
swings after the tool has stopped.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from torchcloth._utils.files import write_text
from torchcloth.diagnosis import build_base_model, list_hypotheses, load_model
from torchcloth.diagnosis.run import BASE_MODEL_FILE, EXTENDED_MODEL_FILE
from torchcloth.recordings import Recording
from torchcloth.recordings.consistency import merge_scene

from ..resumable import ResumableStudy
from ..validation.realdata import swings as iri_swings
from . import air_tables
from .measured import VARIABLE, find, swings
from .measured.swing_predictions import predict, summary
from .resumable_diagnosis import diagnosis_in

GROUPS = 6
SECONDS, FAST_SECONDS = 6.0, 3.0  # from when the tool starts: until then it stands for up to three
FAST_ASKED = ("air.drag_n", "air.linear", "air.added_mass")


def add(parser: argparse.ArgumentParser) -> None:
    """Options."""
    parser.add_argument("--source", type=Path, metavar="DIR", help=f"folder of measured data (${VARIABLE})")


def run(options: argparse.Namespace) -> None:
    """Compute what is missing, then print and draw everything."""
    source = find(options.source) / swings.SOURCE
    study = ResumableStudy(options.out, {"study": "air", "fast": options.fast, "source": str(source.resolve())})
    fitted, held = swings.split(source, fast=False)
    held = held[4:5] if options.fast else held
    groups = {f"group-{k + 1}": names for k, names in enumerate(grouped(fitted)[: 1 if options.fast else GROUPS])}
    cases = {g: partial(diagnosed, source, names, options.out / g, options.fast) for g, names in groups.items()}
    answers = study.run(cases)
    cases = {f"swing-{name}": partial(_predicted, source, name, options.out, list(groups)) for name in held}
    runs = dict(zip(held, study.run(cases).values(), strict=True))
    labels = [f"{when} {g}" for when in ("before", "after") for g in groups]
    found = {"groups": answers, "predicted_runs": held, "predicted": pooled(summary(runs, labels), list(groups))}
    path = write_text(options.out / "air.json", json.dumps(found, indent=1, allow_nan=False) + "\n")
    air_tables.show(found)
    picture = air_tables.draw(found, runs, options.out / "air.png")
    print(f"result:  {path}\npicture: {picture}")


def grouped(names: Sequence[str]) -> list[list[str]]:
    """Threes of different sizes, as many as there are."""
    sizes: dict[str, list[str]] = {}
    for name in names:
        sizes.setdefault(name.partition("_")[0], []).append(name)
    return [list(three) for three in zip(*sizes.values(), strict=False)]


def diagnosed(source: Path, names: Sequence[str], folder: Path, fast: bool) -> dict[str, Any]:
    """The answer of one group; its report and models are written to the folder."""
    seconds = FAST_SECONDS if fast else SECONDS
    recordings = [beginning(source, name, seconds) for name in names]
    asked = [h for h in list_hypotheses(build_base_model(merge_scene(recordings)), recordings) if not fast or h.name in FAST_ASKED]
    answer = diagnosis_in(folder, recordings, hypotheses=asked)
    keys = ("verdict", "causes", "gain", "also_unexplained", "ruled_out", "undecided", "unresolvable", "parameters")
    keys = (*keys, "residual", "next_experiment")
    return {"runs": list(names), "asked": len(asked), **{key: answer.content[key] for key in keys}}


def beginning(source: Path, name: str, seconds: float) -> Recording:
    """A run until that long after the cloth was seen to start."""
    found = swings.recording(source, name)
    data, points = iri_swings.runs(source)[name], found.require("points", by="the study")
    end = iri_swings.start(data) + iri_swings.lag(data).value + seconds
    return replace(found, points=points.only(points.t <= end), markers=None)


def _predicted(source: Path, name: str, out: Path, groups: Sequence[str]) -> dict[str, Any]:
    worlds = {
        f"{when} {g}": load_model(out / g / file, residual=False).build_world()
        for when, file in (("before", BASE_MODEL_FILE), ("after", EXTENDED_MODEL_FILE))
        for g in groups
    }
    return predict(source, name, worlds)


def pooled(found: dict[str, Any], groups: Sequence[str]) -> dict[str, Any]:
    """The mean over groups; errors of the runs, and of what groups differ by (standard error of their mean)."""
    out = {key: found[key] for key in ("measured", "still", "null")}
    for when in ("before", "after"):
        rows = [found[f"{when} {g}"] for g in groups]
        out[when] = {}
        for key in ("rms", "frequency", "decay"):
            values = np.array([row[key] for row in rows])
            between = values.var(ddof=1) / len(rows) if len(rows) > 1 else 0.0
            runs = np.mean([row[f"{key}_std"] ** 2 for row in rows])
            out[when] |= {key: float(values.mean()), f"{key}_std": float((runs + between) ** 0.5)}
        out[when]["groups"] = rows
    return out
