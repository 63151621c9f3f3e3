"""Ablation of the screening: which causes would it call present without one of its parts?

The cases are for development, and most of them hide nothing relevant. Each case is fitted once and screened as a
diagnosis does. It is screened again with uncorrelated slow errors, without nuisances of episodes, with tests against
zero, on one mesh, with bifurcating bins, with fixed parameters of the data sheet, and with tangent slopes. The study
counts the causes that are called present.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from torchcloth.diagnosis import (
    ModelFit,
    build_base_model,
    find_bifurcating_bins,
    fit,
    list_hypotheses,
    prepare_data,
    quadratic_warm_start,
    screen,
)
from torchcloth.diagnosis.inference.bifurcations import drop_bins
from torchcloth.errors import InvalidInput
from torchcloth.recordings import read
from torchcloth.recordings.consistency import merge_scene

from ..resumable import ResumableStudy, check_jobs, write_result
from ..validation.hidden import case_sampling, make_case, reveal_truth
from .fabric_tables import NO_VALUE, make_table
from .screening_ablations import ABLATIONS, with_fixed_parameters, with_tangent_slopes

NULL_SEEDS = (40, 42, 43, 44, 45)  # a null and four hard ones
SINGLE_CAUSE_SEEDS = (6, 567)  # half of a drag, and wind
SCREENING_TRUTH_NODES = 19  # along each side of the true sheet, two thirds of those in a hidden round
ALL_PARTS = "with all parts"


def add(parser: argparse.ArgumentParser) -> None:
    """Add the study's options."""
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="cases at a time (default: 1)")


def run(options: argparse.Namespace) -> None:
    """Compute the missing cases, then print and write screening.json."""
    check_jobs(options.jobs)
    seeds = (*NULL_SEEDS[:1], *SINGLE_CAUSE_SEEDS[:1]) if options.fast else (*NULL_SEEDS, *SINGLE_CAUSE_SEEDS)
    study = ResumableStudy(options.out, {"study": "screening", "fast": options.fast})
    study.start()
    work = {str(seed): partial(screen_case, options.out, seed, options.fast) for seed in seeds}
    results = list(study.run(work, options.jobs).values())
    path = write_result(options.out / "screening.json", "screening", {"cases": results})
    show(results)
    print(f"result: {path}")


def screen_case(out: Path, seed: int, fast: bool) -> dict[str, Any]:
    """Screen a case in each way; return also what is hidden in it."""
    episodes = out / "episodes" / str(seed)
    how = ["--fast"] if fast else ["--nodes", str(SCREENING_TRUTH_NODES)]
    if make_case.main(["--seed", str(seed), "--out", str(episodes), *how]):
        raise InvalidInput("studies screening", got=f"case {seed} that could not be made", expected="its episodes")
    episode_folders = sorted(
        path for path in episodes.iterdir() if not path.name.startswith(".")
    )  # hidden folders are left by a stopped run
    recordings = [read(path) for path in episode_folders]
    truth = reveal_truth.reveal_truth(
        case_sampling.draw_case(seed, case_sampling.FAST_SIZE if fast else case_sampling.ROUND_SIZE)
    )
    hidden = [e for e in truth["effects"] if e["typical_fraction"] >= case_sampling.HALF_SIZE]
    rows_by_way = {name: [_screening_row(row) for row in screen(fit)] for name, fit in _fits_by_way(recordings).items()}
    return {"seed": seed, "family": truth["family"], "hidden": hidden, "ways": rows_by_way}


def _fits_by_way(recordings: Sequence[Any]) -> dict[str, ModelFit]:
    """Return the fit as a diagnosis screens it, and without each part."""
    model = build_base_model(merge_scene(recordings))
    setting, hypotheses = prepare_data(model, recordings), list_hypotheses(model, recordings)
    near, before = quadratic_warm_start(model, setting)
    whole = fit(near, setting, hypotheses, before=before)
    results = drop_bins(whole, find_bifurcating_bins(whole, setting))
    return {
        ALL_PARTS: results,
        **{name: way(results) for name, way in ABLATIONS.items()},
        "with cells that jump": whole,
        "data sheet that does not give way": with_fixed_parameters(fit(model, setting, hypotheses, 0, before=before)),
        "by tangents": with_tangent_slopes(results, setting),
    }


def _screening_row(row: Any) -> dict[str, Any]:
    std = row.total if row.total < float("inf") else None
    return {"effect": row.hypothesis.name, "amplitude": row.amplitude, "std": std, "decision": row.decision}


def show(results: Sequence[Mapping[str, Any]]) -> None:
    """Print a table of false and true causes that are called present."""
    from rich.console import Console

    order = sorted(results, key=lambda case: bool(case["hidden"]))
    headings = (
        "+".join(e["hypothesis"] for e in case["hidden"] if not e["is_enabling"]) or f"{case['seed']}: {case['family']}"
        for case in order
    )
    title = "Number of false causes called present (in brackets: amplitude of true causes / truth)"
    rows_table = make_table(title, "screened", *headings, left=1)
    for way in results[0]["ways"]:
        rows_table.add_row(way, *(count_present(case, way) for case in order))
    console = Console(highlight=False, markup=False)
    console.width = max(console.width, 150)
    console.print(rows_table)


def count_present(case: Mapping[str, Any], way: str) -> str:
    """Return the number of false causes, and the relative amplitudes of the true ones."""
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
    return f"{false} ({', '.join(sizes) or NO_VALUE})"


def _is(name: str, hidden: Mapping[str, Any]) -> bool:
    """Whether a cause is the hidden one; for a cause with an axis, only along the hidden axis."""
    return name == hidden["hypothesis"] or name in hidden["names"]
