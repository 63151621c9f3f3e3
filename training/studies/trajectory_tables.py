"""Tables of the trajectories study."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .manipulations.console_tables import heading_table

FIRST_METHOD = "gauss-newton"


def group_cases(results: Mapping[str, Any]) -> dict[tuple[str, str, str], dict[int, dict[str, Any]]]:
    """Group the cases by garment, action and method; return those of each group by seed."""
    groups: dict[tuple[str, str, str], dict[int, dict[str, Any]]] = {}
    for case in results.values():
        groups.setdefault((case["garment"], case["action"], case["method"]), {})[case["seed"]] = case
    return groups


def retained_fraction(case: Mapping[str, Any]) -> float | None:
    """Return the fraction of the expected improvement that remains on the finer mesh; None without improvement."""
    expected = case["recorded_expected"] - case["expected"]
    if case["executed"] is None or expected <= 0:
        return None
    return (case["recorded"] - case["executed"]) / expected


def count_first_wins(results: Mapping[str, Any], method: str, action: str) -> tuple[int, int]:
    """Count the garment-seed pairs in which Gauss-Newton ends below the best motion of a method, and all pairs."""
    groups = group_cases({name: case for name, case in results.items() if case["action"] == action})
    wins = pairs = 0
    for (garment, _, name), cases in groups.items():
        for seed, case in cases.items() if name == method else ():
            first = groups[garment, action, FIRST_METHOD].get(seed)
            if first is not None:
                pairs += 1
                wins += first["expected"] < case["expected"]
    return wins, pairs


def build_summary_table(results: Mapping[str, Any]):
    """Return one row for each garment, action and method, and a row for each method over all garments."""
    headings = ("recorded", "expected", "executed", "MuJoCo", "retained", "motions", "CPU s", "violations", "worse")
    table = heading_table("Distance from the goal [mm], medians over seeds", "garment", "by", *headings)
    groups = group_cases(results)
    for (garment, action, method), cases in sorted(groups.items(), key=lambda item: item[0][:2]):
        rows = list(cases.values())
        label = garment if action == "carry" else f"{garment}, {action}"
        lengths = [
            _spread([1e3 * c[key] if c[key] is not None else None for c in rows])
            for key in ("recorded", "expected", "executed", "mujoco_executed")
        ]
        retained = _spread([None if (r := retained_fraction(c)) is None else 100 * r for c in rows], "{:.0f} %")
        counts = [_median([c[key] for c in rows]) for key in ("motions", "seconds")]
        violations = str(sum(c["limit_violations"] for c in rows))
        first = groups.get((garment, action, FIRST_METHOD), {})
        worse = sum(first[s]["expected"] < c["expected"] for s, c in cases.items() if s in first)
        wins = "" if method == FIRST_METHOD else f"{worse} of {len(rows)}"
        table.add_row(label, method, *lengths, retained, *counts, violations, wins)
    table.add_section()
    methods = dict.fromkeys(case["method"] for case in results.values())
    for method in methods:
        rows = [c for c in results.values() if c["method"] == method and c["action"] == "carry"]
        if not rows:
            continue
        wins, pairs = count_first_wins(results, method, "carry")
        retained = _spread([None if (r := retained_fraction(c)) is None else 100 * r for c in rows], "{:.0f} %")
        lengths = [_median([1e3 * c[k] for c in rows if c[k] is not None], 1) for k in ("recorded", "expected")]
        lengths += [_median([1e3 * c[k] for c in rows if c[k] is not None], 1) for k in ("executed", "mujoco_executed")]
        counts = [_median([c[key] for c in rows]) for key in ("motions", "seconds")]
        violations = str(sum(c["limit_violations"] for c in rows))
        of = "" if method == FIRST_METHOD else f"{wins} of {pairs}"
        table.add_row("all, carry", method, *lengths, retained, *counts, violations, of)
    return table


def build_chaos_table(results: Mapping[str, Any]):
    """Return one row for each garment and action."""
    table = heading_table(
        "Chaos: vertices apart after a disturbance of 0.1 mm [mm]",
        *("garment", "action", "recorded motion", "hidden motions", "meshes", "moved"),
    )
    for case in results.values():
        lists = [_spread([1e3 * x for x in case[key]]) for key in ("hidden", "meshes", "moved")]
        table.add_row(case["garment"], case["action"], f"{1e3 * case['recorded']:.1f}", *lists)
    return table


def _spread(values: Sequence[float | None], form: str = "{:.1f}") -> str:
    numbers = [value for value in values if value is not None]
    if not numbers:
        return "–"
    middle = form.format(float(np.median(numbers)))
    bare = form.partition("}")[0] + "}"
    return middle if len(numbers) == 1 else f"{middle} [{bare.format(min(numbers))}, {bare.format(max(numbers))}]"


def _median(values: Sequence[float], digits: int = 0) -> str:
    return f"{float(np.median(values)):.{digits}f}" if len(values) else "–"
