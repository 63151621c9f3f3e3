"""Influence of action speed, grip and initial posture: grand mean and the paper's pooled variance."""

from __future__ import annotations

import argparse
from typing import Any

from ..resumable import write_result
from .manipulations import manipulation_figures, paper_tables, study_cases
from .manipulations.cases import PAPER_PARAMETERS
from .manipulations.console_tables import heading_table, mm, number, show
from .manipulations.measures import Pooled, pooled_variance
from .manipulations.scenes import GRIPS, POSTURES, SPEEDS

FACTOR_LEVELS = {"speed": SPEEDS, "grip": GRIPS, "posture": POSTURES}
CHAMFER_CONVENTIONS = ("vertices", "surface")
MIN_VALUES_FOR_VARIANCE = 3


def add(parser: argparse.ArgumentParser) -> None:
    """Add the study's options."""
    study_cases.add(parser)


def run(options: argparse.Namespace) -> None:
    """Compute the missing cases, then print both tables."""
    cases = study_cases.load_or_compute(options)
    by_factor = {factor: {c: distances(cases, factor, c) for c in CHAMFER_CONVENTIONS} for factor in FACTOR_LEVELS}
    values = {factor: {name: estimates(cases, factor, name) for name in PAPER_PARAMETERS} for factor in FACTOR_LEVELS}
    show(_distance_table(by_factor), _parameter_table(values), *_notes(len(cases)))
    write_result(
        options.out / "factors.json",
        "factors",
        {"distance": _plain(by_factor), "parameters_over_truth": _plain(values), "cases": len(cases)},
    )
    manipulation_figures.levels(
        {factor: entry["surface"] for factor, entry in by_factor.items()}, options.out / "factors.png"
    )


def distances(cases: dict[str, dict[str, Any]], factor: str, convention: str) -> Pooled:
    """Return the Chamfer distance [m] of the fitted cloth by level of a factor."""
    return _by_level(cases, factor, lambda c: c["distance"]["fit"][convention] if "distance" in c else None)


def estimates(cases: dict[str, dict[str, Any]], factor: str, name: str) -> Pooled:
    """Return an identified parameter divided by its truth (which differs between garments), by level of a factor."""

    def value(case: dict[str, Any]) -> float | None:
        known = case.get("estimates", {}).get(name, {"identifiable": False})
        return known["value"] / case["truth"][name] if known["identifiable"] else None

    return _by_level(cases, factor, value)


def _by_level(cases: dict[str, dict[str, Any]], factor: str, value: Any) -> Pooled:
    groups: dict[str, list[float]] = {level: [] for level in FACTOR_LEVELS[factor]}
    for case in cases.values():
        entry = value(case)
        if entry is not None:
            groups[case["manipulation"][factor]].append(entry)
    return pooled_variance(groups)


def _distance_table(by_factor: dict[str, dict[str, Pooled]]):
    table = heading_table(
        "Chamfer distance of the fitted garments over the levels of a factor", "factor", "to", "mean [mm]",
        "variance [m²]", "between levels", "levels [mm]", "| paper: mean [mm]", "variance [m²]",
    )  # fmt: skip
    for factor, conventions in by_factor.items():
        mean, variance = paper_tables.FACTORS[factor]
        for convention, p in conventions.items():
            levels = " / ".join(
                mm(p.levels[level].mean) if level in p.levels else "–" for level in FACTOR_LEVELS[factor]
            )
            paper_cells = [mm(mean), f"{variance:.2e}"] if convention == "vertices" else ["", ""]
            cells = [mm(p.mean), number(p.pooled_variance, 3), _share(p), levels]
            table.add_row(factor, convention, *cells, *paper_cells, end_section=convention == CHAMFER_CONVENTIONS[-1])
    return table


def _parameter_table(values: dict[str, dict[str, Pooled]]):
    title = "Identified parameters divided by their truth (1 is correct)"
    table = heading_table(title, "factor", "parameter", "mean", "variance", "between levels", "levels", "cases")
    for factor, names in values.items():
        for name, p in names.items():
            count = sum(entry.count for entry in p.levels.values())
            levels = " / ".join(
                number(p.levels[level].mean, 3) if level in p.levels else "–" for level in FACTOR_LEVELS[factor]
            )
            cells = [number(p.mean, 3), number(p.pooled_variance, 3), _share(p), levels]
            empty_cells = ["too few" if count else "not identifiable", "", "", ""]
            value_cells = cells if count >= MIN_VALUES_FOR_VARIANCE else empty_cells
            table.add_row(factor, name, *value_cells, str(count), end_section=name == PAPER_PARAMETERS[-1])
    return table


def _notes(cases: int) -> list[str]:
    """Return notes on the numbers."""
    levels = "; ".join(f"{factor}: {' / '.join(names)}" for factor, names in FACTOR_LEVELS.items())
    return [
        f"Levels: {levels}. vertices: cloud to the nearest vertex (the paper's); surface: cloud to surface (ours).",
        "The paper's pooled variance adds the variances within and between the levels. This is the variance of all "
        "values, so it is the same for every factor. The effect of a factor is the fraction between its levels. In "
        f"brackets: the mean of this fraction without any effect. {cases} cases.",
    ]


def _share(p: Pooled) -> str:
    """Format the fraction between levels, with its mean without any effect."""
    count = sum(entry.count for entry in p.levels.values())
    chance = f" ({100 * (len(p.levels) - 1) / (count - 1):.0f})" if count > 1 else ""
    return f"{100 * p.between / p.pooled_variance:.0f} %{chance}" if p.pooled_variance > 0 else "–"


def _plain(values: dict[str, dict[str, Pooled]]) -> dict[str, Any]:
    return {
        factor: {
            name: p._asdict() | {"levels": {level: entry._asdict() for level, entry in p.levels.items()}}
            for name, p in entry.items()
        }
        for factor, entry in values.items()
    }
