"""Distance of fitted garments from the observations, by action and by garment, with the paper's two tables."""

from __future__ import annotations

import argparse
from typing import Any

from ..resumable import write_result
from .manipulations import manipulation_figures, paper_tables, study_cases
from .manipulations.console_tables import heading_table, mm, percent, show
from .manipulations.measures import Spread, sample_spread
from .manipulations.scenes import ACTIONS, STUDY_GARMENTS

STATE_LABELS = {"null": "rigid carry", "start": "not fitted", "fit": "fitted"}
CONVENTION_TEXT = {
    "vertices": "cloud to the nearest vertex, one-sided: the paper's loss, which cannot fall below a third of an edge",
    "surface": "cloud to surface, one-sided: ours",
    "pose": "root mean square distance of all vertices from their true places, hidden ones included",
}


def add(parser: argparse.ArgumentParser) -> None:
    """Add the study's options."""
    study_cases.add(parser)


def run(options: argparse.Namespace) -> None:
    """Compute the missing cases, then print both tables."""
    cases = study_cases.load_or_compute(options)
    result = {by: summarise(cases, by, names) for by, names in (("action", ACTIONS), ("garment", STUDY_GARMENTS))}
    failed = sum("failed" in case for case in cases.values())
    show(*(_table(by, rows) for by, rows in result.items()), *_notes(len(cases), failed))
    write_result(options.out / "chamfer.json", "chamfer", {"by": result, "cases": len(cases), "failed": failed})
    manipulation_figures.distances(result, options.out / "chamfer.png")


def summarise(
    cases: dict[str, dict[str, Any]], by: str, names: tuple[str, ...]
) -> dict[str, dict[str, dict[str, Any]]]:
    """Return name -> convention -> state -> mean [m], CoV and number of cases."""
    out = {}
    for name in names:
        distances = [c["distance"] for c in cases.values() if c["manipulation"][by] == name and "distance" in c]
        if distances:
            out[name] = {
                convention: {
                    state: sample_spread([d[state][convention] for d in distances])._asdict() for state in STATE_LABELS
                }
                for convention in CONVENTION_TEXT
            }
    return out


def _table(by: str, rows: dict[str, dict[str, dict[str, Any]]]):
    title = f"Mean distance [mm] by {by}, over all frames (late frames were not fitted but predicted)"
    table = heading_table(title, by, "convention", *STATE_LABELS.values(), "CoV", "cases", "| paper", "CoV")
    for name, conventions in rows.items():
        mean, cov = paper_tables.CHAMFER[name]
        for convention, states in conventions.items():
            fit = Spread(**states["fit"])
            paper_cells = [mm(mean), f"{cov:.1f} %"] if convention == "vertices" else ["", ""]
            cells = [mm(states[state]["mean"]) for state in STATE_LABELS]
            last = convention == "pose"
            table.add_row(name, convention, *cells, percent(fit.cov), str(fit.count), *paper_cells, end_section=last)
    return table


def _notes(cases: int, failed: int) -> list[str]:
    """Return notes on the conventions and on the comparison with the paper."""
    words = "; ".join(f"{name}: {text}" for name, text in CONVENTION_TEXT.items())
    return [
        words + ".",
        f"{cases} cases, {failed} of them failed. Ours are synthetic, with the same law in truth and model. They show "
        "the error of method, mesh and sensor, not that of a wrong law. The paper's are of real garments. The paper's "
        "convention depends on the edge length of the mesh: compare our 'vertices' at 1500 triangles only.",
    ]
