"""What screening would say without one of its parts: cases for development, most of which hide nothing that matters.

Each case is fitted once; then its cells are screened as a diagnosis does, and again with slow errors that agree with
no neighbour, with episodes that differ in nothing but noise, tested against zero, on one mesh, with cells that jump,
from a data sheet that does not give way, and by tangents. What is "present" then is counted.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from torchcloth._utils.files import write_text
from torchcloth.diagnosis import ModelFit, quadratic_warm_start, build_base_model, list_hypotheses, fit, screen, prepare_data, find_bifurcating_bins
from torchcloth.diagnosis.inference.bifurcations import drop_bins
from torchcloth.errors import InvalidInput
from torchcloth.recordings import read
from torchcloth.recordings.consistency import merge_scene

from ..resumable import ResumableStudy, check_jobs
from ..validation.hidden import case_sampling, make_case, reveal_truth
from .fabric_tables import NOTHING, table
from .screening_ablations import WAYS, rigid, tangents

# numbers for development: a null and four hard ones; half of a drag, and wind
NULLS, SINGLES = (40, 42, 43, 44, 45), (6, 567)
NODES = 19  # of the truth's sides, two thirds of the round's
ALL = "with all parts"


def add(parser: argparse.ArgumentParser) -> None:
    """Options."""
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="cases at a time (1)")


def run(options: argparse.Namespace) -> None:
    """Compute what is missing, then print and write parts.json."""
    check_jobs(options.jobs)
    seeds = (*NULLS[:1], *SINGLES[:1]) if options.fast else (*NULLS, *SINGLES)
    study = ResumableStudy(options.out, {"study": "parts", "fast": options.fast})
    study.start()
    work = {str(seed): partial(one, options.out, seed, options.fast) for seed in seeds}
    found = list(study.run(work, options.jobs).values())
    path = write_text(options.out / "parts.json", json.dumps(found, indent=1, allow_nan=False) + "\n")
    show(found)
    print(f"result: {path}")


def one(out: Path, seed: int, fast: bool) -> dict[str, Any]:
    """What is hidden in a case, and what each way of screening says of it and calls present."""
    episodes = out / "episodes" / str(seed)
    how = ["--fast"] if fast else ["--nodes", str(NODES)]
    if make_case.main(["--seed", str(seed), "--out", str(episodes), *how]):
        raise InvalidInput("studies parts", got=f"case {seed} that could not be made", expected="its episodes")
    made = sorted(path for path in episodes.iterdir() if not path.name.startswith("."))  # nor what a stopped one left
    recordings = [read(path) for path in made]
    truth = reveal_truth.reveal_truth(case_sampling.draw_case(seed, case_sampling.FAST_SIZE if fast else case_sampling.ROUND_SIZE))
    hidden = [e for e in truth["effects"] if e["typical_fraction"] >= case_sampling.HALF_SIZE]
    told = {name: [_told(row) for row in screen(fit)] for name, fit in _ways(recordings).items()}
    return {"seed": seed, "family": truth["family"], "hidden": hidden, "ways": told}


def _ways(recordings: Sequence[Any]) -> dict[str, ModelFit]:
    """The fit as a diagnosis screens it, and without each part."""
    model = build_base_model(merge_scene(recordings))
    setting, asked = prepare_data(model, recordings), list_hypotheses(model, recordings)
    near, before = quadratic_warm_start(model, setting)
    whole = fit(near, setting, asked, before=before)
    found = drop_bins(whole, find_bifurcating_bins(whole, setting))
    return {
        ALL: found,
        **{name: way(found) for name, way in WAYS.items()},
        "with cells that jump": whole,
        "data sheet that does not give way": rigid(fit(model, setting, asked, 0, before=before)),
        "by tangents": tangents(found, setting),
    }


def _told(row: Any) -> dict[str, Any]:
    std = row.total if row.total < float("inf") else None
    return {"effect": row.hypothesis.name, "amplitude": row.amplitude, "std": std, "decision": row.decision}


def show(found: Sequence[Mapping[str, Any]]) -> None:
    """As a table: what is present that is not there, and whether what is there is."""
    from rich.console import Console

    order = sorted(found, key=lambda case: bool(case["hidden"]))
    headings = (
        "+".join(e["hypothesis"] for e in case["hidden"] if not e["is_enabling"]) or f"{case['seed']}: {case['family']}"
        for case in order
    )
    title = "Present, and not there or too small to matter (of what is there: amplitude asked for / truth)"
    filled = table(title, "screened", *headings, left=1)
    for way in found[0]["ways"]:
        filled.add_row(way, *(counted(case, way) for case in order))
    console = Console(highlight=False, markup=False)
    console.width = max(console.width, 150)
    console.print(filled)


def counted(case: Mapping[str, Any], way: str) -> str:
    """How many are present and not there, and how large what is there would be."""
    rows = [row for row in case["ways"][way] if row["decision"] == "present"]
    false = sum(not any(_is(row["effect"], e) for e in case["hidden"]) for row in rows)
    if not case["hidden"]:
        return str(false)
    sizes = [
        f"{row['amplitude'] / (e['amplitude'] * e['sign']):.2f}"
        for e in case["hidden"]
        for row in rows
        if row["effect"] == e["hypothesis"] and e["sign"] and not e["is_enabling"]
    ]
    return f"{false} ({', '.join(sizes) or NOTHING})"


def _is(name: str, hidden: Mapping[str, Any]) -> bool:
    """The library's word for what is hidden; with an axis only along its own."""
    return name == hidden["hypothesis"] or name in hidden["names"]
