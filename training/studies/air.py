"""Is air the missing cause in real swings? Diagnoses of IRI swings, and predictions of held-out runs.

Groups of three swings of different sizes are diagnosed as ``torchcloth diagnose`` does. Each diagnosis starts from a
base model in vacuum and tests all hypotheses of the catalogue; its report is stored. Then the model of each group
predicts held-out runs, without and with the named causes. Compared are the distance of the nodes, and frequency and
decay of the free swings after the tool has stopped.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from torchcloth.diagnosis import build_base_model, list_hypotheses, load_model
from torchcloth.diagnosis.run import BASE_MODEL_FILE, EXTENDED_MODEL_FILE
from torchcloth.recordings import Recording
from torchcloth.recordings.consistency import merge_scene

from ..resumable import ResumableStudy, write_result
from ..validation.realdata import swings as iri_swings
from . import air_tables
from .measured import DATA_VARIABLE, find_data_folder, swings
from .measured.swing_predictions import predict, summary
from .resumable_diagnosis import diagnosis_in

GROUP_COUNT = 6
EPISODE_S, FAST_EPISODE_S = 6.0, 3.0  # after the tool starts; it stands still for up to 3 s before
FAST_HYPOTHESES = ("air.drag_n", "air.linear", "air.added_mass")


def add(parser: argparse.ArgumentParser) -> None:
    """Add the study's options."""
    parser.add_argument("--source", type=Path, metavar="DIR", help=f"folder of measured data (${DATA_VARIABLE})")


def run(options: argparse.Namespace) -> None:
    """Compute the missing cases, then print and draw the result."""
    source = find_data_folder(options.source) / swings.SOURCE_NAME
    study = ResumableStudy(options.out, {"study": "air", "fast": options.fast, "source": str(source.resolve())})
    fitted, predicted_runs = swings.split(source, fast=False)
    predicted_runs = predicted_runs[4:5] if options.fast else predicted_runs
    groups = {
        f"group-{k + 1}": names for k, names in enumerate(group_by_size(fitted)[: 1 if options.fast else GROUP_COUNT])
    }
    cases = {g: partial(diagnose_group, source, names, options.out / g, options.fast) for g, names in groups.items()}
    answers = study.run(cases)
    cases = {f"swing-{name}": partial(_predict_run, source, name, options.out, list(groups)) for name in predicted_runs}
    runs = dict(zip(predicted_runs, study.run(cases).values(), strict=True))
    labels = [f"{when} {g}" for when in ("before", "after") for g in groups]
    result = {
        "groups": answers,
        "predicted_runs": predicted_runs,
        "predicted": pool_groups(summary(runs, labels), list(groups)),
    }
    path = write_result(options.out / "air.json", "air", result)
    air_tables.show(result)
    picture = air_tables.draw(result, runs, options.out / "air.png")
    print(f"result:  {path}\npicture: {picture}")


def group_by_size(names: Sequence[str]) -> list[list[str]]:
    """Return groups of three runs of different sizes."""
    sizes: dict[str, list[str]] = {}
    for name in names:
        sizes.setdefault(name.partition("_")[0], []).append(name)
    return [list(three) for three in zip(*sizes.values(), strict=False)]


def diagnose_group(source: Path, names: Sequence[str], folder: Path, fast: bool) -> dict[str, Any]:
    """Diagnose one group; its report and models are written to the folder."""
    seconds = FAST_EPISODE_S if fast else EPISODE_S
    recordings = [crop_start(source, name, seconds) for name in names]
    hypotheses = [
        h
        for h in list_hypotheses(build_base_model(merge_scene(recordings)), recordings)
        if not fast or h.name in FAST_HYPOTHESES
    ]
    answer = diagnosis_in(folder, recordings, hypotheses=hypotheses)
    keys = ("verdict", "causes", "gain", "also_unexplained", "ruled_out", "undecided", "unresolvable", "parameters")
    keys = (*keys, "residual", "next_experiment")
    return {"runs": list(names), "asked": len(hypotheses), **{key: answer.content[key] for key in keys}}


def crop_start(source: Path, name: str, seconds: float) -> Recording:
    """Return the beginning of a run, until some seconds after the cloth starts to move."""
    recording = swings.recording(source, name)
    data, points = iri_swings.read_runs(source)[name], recording.require("points", by="the study")
    end = iri_swings.motion_start(data) + iri_swings.estimate_lag(data).value + seconds
    return replace(recording, points=points.select(points.t <= end), markers=None)


def _predict_run(source: Path, name: str, out: Path, groups: Sequence[str]) -> dict[str, Any]:
    worlds = {
        f"{when} {g}": load_model(out / g / file, residual=False).build_world()
        for when, file in (("before", BASE_MODEL_FILE), ("after", EXTENDED_MODEL_FILE))
        for g in groups
    }
    return predict(source, name, worlds)


def pool_groups(result: dict[str, Any], groups: Sequence[str]) -> dict[str, Any]:
    """Return means over groups; standard errors include the runs and the scatter between groups."""
    out = {key: result[key] for key in ("measured", "still", "null")}
    for when in ("before", "after"):
        rows = [result[f"{when} {g}"] for g in groups]
        out[when] = {}
        for key in ("rms", "frequency", "decay"):
            values = np.array([row[key] for row in rows])
            between = values.var(ddof=1) / len(rows) if len(rows) > 1 else 0.0
            runs = np.mean([row[f"{key}_std"] ** 2 for row in rows])
            out[when] |= {key: float(values.mean()), f"{key}_std": float((runs + between) ** 0.5)}
        out[when]["groups"] = rows
    return out
