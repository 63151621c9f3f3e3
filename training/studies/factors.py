"""Influence of action speed, grasp point and initial posture: grand mean and the paper's pooled variance."""

from __future__ import annotations

import argparse
from typing import Any

from .manipulations import manipulation_figures, paper_tables, study_cases
from .manipulations.cases import SOUGHT
from .manipulations.console_tables import heading_table, mm, number, show, write
from .manipulations.measures import Pooled, pooled
from .manipulations.scenes import GRIPS, POSTURES, SPEEDS

FACTORS = {"speed": SPEEDS, "grip": GRIPS, "posture": POSTURES}
CONVENTIONS = ("vertices", "surface")
LEAST = 3  # values before their variance is shown


def add(parser: argparse.ArgumentParser) -> None:
    """Options."""
    study_cases.add(parser)


def run(chosen: argparse.Namespace) -> None:
    """All cases, then both tables."""
    found = study_cases.cases(chosen)
    seen = {factor: {c: distances(found, factor, c) for c in CONVENTIONS} for factor in FACTORS}
    values = {factor: {name: estimates(found, factor, name) for name in SOUGHT} for factor in FACTORS}
    show(_distance_table(seen), _parameter_table(values), *_notes(len(found)))
    write(
        chosen.out / "factors.json",
        {"distance": _plain(seen), "parameters_over_truth": _plain(values), "cases": len(found)},
    )
    manipulation_figures.levels({factor: own["surface"] for factor, own in seen.items()}, chosen.out / "factors.png")


def distances(found: dict[str, dict[str, Any]], factor: str, convention: str) -> Pooled:
    """Chamfer distance [m] of the fitted cloth, by level of a factor."""
    return _by_level(found, factor, lambda c: c["distance"]["fit"][convention] if "distance" in c else None)


def estimates(found: dict[str, dict[str, Any]], factor: str, name: str) -> Pooled:
    """An identified parameter by its truth (garments differ in it), by level of a factor."""

    def value(case: dict[str, Any]) -> float | None:
        known = case.get("found", {}).get(name, {"identifiable": False})
        return known["value"] / case["truth"][name] if known["identifiable"] else None

    return _by_level(found, factor, value)


def _by_level(found: dict[str, dict[str, Any]], factor: str, value: Any) -> Pooled:
    groups: dict[str, list[float]] = {level: [] for level in FACTORS[factor]}
    for case in found.values():
        own = value(case)
        if own is not None:
            groups[case["manipulation"][factor]].append(own)
    return pooled(groups)


def _distance_table(seen: dict[str, dict[str, Pooled]]):
    table = heading_table(
        "Chamfer distance of the fitted garments over the levels of a factor", "factor", "to", "mean [mm]",
        "variance [m²]", "between levels", "levels [mm]", "| paper: mean [mm]", "variance [m²]",
    )  # fmt: skip
    for factor, conventions in seen.items():
        mean, variance = paper_tables.FACTORS[factor]
        for convention, p in conventions.items():
            levels = " / ".join(mm(p.levels[level].mean) if level in p.levels else "–" for level in FACTORS[factor])
            theirs = [mm(mean), f"{variance:.2e}"] if convention == "vertices" else ["", ""]
            cells = [mm(p.mean), number(p.pooled, 3), _share(p), levels]
            table.add_row(factor, convention, *cells, *theirs, end_section=convention == CONVENTIONS[-1])
    return table


def _parameter_table(values: dict[str, dict[str, Pooled]]):
    title = "Identified parameters over their truth (1 is right)"
    table = heading_table(title, "factor", "parameter", "mean", "variance", "between levels", "levels", "cases")
    for factor, names in values.items():
        for name, p in names.items():
            count = sum(own.count for own in p.levels.values())
            levels = " / ".join(
                number(p.levels[level].mean, 3) if level in p.levels else "–" for level in FACTORS[factor]
            )
            cells = [number(p.mean, 3), number(p.pooled, 3), _share(p), levels]
            none = ["too few" if count else "not identifiable", "", "", ""]
            shown = cells if count >= LEAST else none
            table.add_row(factor, name, *shown, str(count), end_section=name == SOUGHT[-1])
    return table


def _notes(cases: int) -> list[str]:
    """What the numbers are worth."""
    levels = "; ".join(f"{factor}: {' / '.join(names)}" for factor, names in FACTORS.items())
    return [
        f"Levels: {levels}. vertices: cloud to the nearest vertex (the paper's); surface: cloud to surface (ours).",
        "The paper's pooled variance adds the variances within and between the levels, which gives that of all values: "
        "of the same cases it is the same for every factor. What a factor does is the share between its levels; "
        f"without any effect that is on average what stands in brackets; {cases} cases were asked for.",
    ]


def _share(p: Pooled) -> str:
    """With what it would be on average without any effect, of so many values at so many levels."""
    count = sum(own.count for own in p.levels.values())
    chance = f" ({100 * (len(p.levels) - 1) / (count - 1):.0f})" if count > 1 else ""
    return f"{100 * p.between / p.pooled:.0f} %{chance}" if p.pooled > 0 else "–"


def _plain(values: dict[str, dict[str, Pooled]]) -> dict[str, Any]:
    return {
        factor: {
            name: p._asdict() | {"levels": {level: own._asdict() for level, own in p.levels.items()}}
            for name, p in own.items()
        }
        for factor, own in values.items()
    }
