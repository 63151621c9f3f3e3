"""Influence of action speed, grasp point and initial posture: grand mean and the paper's pooled variance."""

from __future__ import annotations

import argparse
from typing import Any

from .manipulations import options, paper, pictures
from .manipulations.cases import SOUGHT
from .manipulations.measures import Pooled, pooled
from .manipulations.printing import heading_table, mm, number, show, write
from .manipulations.scenes import GRIPS, POSTURES, SPEEDS

FACTORS = {"speed": SPEEDS, "grip": GRIPS, "posture": POSTURES}
CONVENTIONS = ("vertices", "surface")


def add(parser: argparse.ArgumentParser) -> None:
    """Options."""
    options.add(parser)


def run(chosen: argparse.Namespace) -> None:
    """All cases, then both tables."""
    found = options.cases(chosen)
    seen = {factor: {c: distances(found, factor, c) for c in CONVENTIONS} for factor in FACTORS}
    values = {factor: {name: estimates(found, factor, name) for name in SOUGHT} for factor in FACTORS}
    show(_distance_table(seen), _parameter_table(values), *NOTES)
    write(
        chosen.out / "factors.json",
        {"distance": _plain(seen), "parameters_over_truth": _plain(values), "cases": len(found)},
    )
    pictures.levels({factor: own["surface"] for factor, own in seen.items()}, chosen.out / "factors.png")


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
    title = "Chamfer distance of the fitted garments over the levels of a factor"
    table = heading_table(
        title, "factor", "convention", "grand mean [mm]", "pooled variance [m²]", "share between levels",
        "levels [mm]", "| paper: grand mean [mm]", "pooled variance",
    )  # fmt: skip
    for factor, conventions in seen.items():
        mean, variance = paper.FACTORS[factor]
        for convention, p in conventions.items():
            levels = ", ".join(f"{level} {mm(own.mean)}" for level, own in p.levels.items())
            theirs = [mm(mean), f"{variance:.2e}"] if convention == "vertices" else ["", ""]
            table.add_row(factor, convention, mm(p.mean), f"{p.pooled:.2e}", _share(p), levels, *theirs)
    return table


def _parameter_table(values: dict[str, dict[str, Pooled]]):
    title = "Identified parameters, over their truth (1 is right)"
    table = heading_table(
        title, "factor", "parameter", "grand mean", "pooled variance", "share between levels", "cases"
    )
    for factor, names in values.items():
        for name, p in names.items():
            count = sum(own.count for own in p.levels.values())
            cells = [number(p.mean), number(p.pooled), _share(p)] if count > 1 else ["not identifiable", "", ""]
            table.add_row(factor, name, *cells, str(count))
    return table


def _share(p: Pooled) -> str:
    return f"{100 * p.between / p.pooled:.0f} %" if p.pooled > 0 else "–"


def _plain(values: dict[str, dict[str, Pooled]]) -> dict[str, Any]:
    return {
        factor: {
            name: p._asdict() | {"levels": {level: own._asdict() for level, own in p.levels.items()}}
            for name, p in own.items()
        }
        for factor, own in values.items()
    }


NOTES = (
    "The paper's pooled variance (within the levels plus between them) is the variance of all values, so with the same "
    "cases it cannot differ between factors: the share between the levels is what a factor does. With three levels and "
    "no effect at all it is about 2 / (n - 1): 7 % of 30 cases.",
)
