"""Tables of a hidden round: for a terminal, and as Markdown for the docs."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from . import hidden_rates
from .fabric_tables import NO_VALUE, make_table
from .hidden_rates import Rate, Target, compute_further_rates, compute_targets
from .hidden_scores import NULL_FAMILIES

MAX_DIAGNOSIS_S = 240.0  # budget of a diagnosis of this size
TARGET_COLUMNS = ("figure", "must", "aim", "is", "95 %", "of", "")


def print_tables(cases: Sequence[Mapping[str, Any]]) -> None:
    """Print the targets, further rates, and every case."""
    from rich.console import Console

    console = Console(highlight=False)
    console.width = max(console.width, 130)
    console.print(_fill_table("What must show", TARGET_COLUMNS, [_target_row(m) for m in compute_targets(cases)]))
    console.print(
        _fill_table(
            "Further", ("figure", "is", "95 %", "of"), [_rate_row(*row) for row in compute_further_rates(cases)]
        )
    )
    console.print(_fill_table("Every case", CASE_COLUMNS, [_case_row(c) for c in cases], left=7))
    console.print(describe_durations(cases), markup=False)


def to_markdown(cases: Sequence[Mapping[str, Any]]) -> str:
    """Return the same tables as Markdown."""
    parts = [
        _markdown_table(TARGET_COLUMNS, [_target_row(m) for m in compute_targets(cases)]),
        _markdown_table(("figure", "is", "95 %", "of"), [_rate_row(*row) for row in compute_further_rates(cases)]),
        _markdown_table(CASE_COLUMNS, [_case_row(c) for c in cases]),
    ]
    return "\n\n".join(parts) + f"\n\n{describe_durations(cases)}\n"


def tabulate_rounds(rounds: Mapping[str, Sequence[Mapping[str, Any]]]) -> str:
    """Return Markdown with a column for each round and one for the cases of all rounds."""
    columns = [_format_figures(cases) for cases in (*rounds.values(), [c for cases in rounds.values() for c in cases])]
    rows = [(label, *(c[label][0] for c in columns), columns[-1][label][1]) for label in columns[-1]]
    counts = [f"{name} ({len(cases)})" for name, cases in rounds.items()]
    return _markdown_table(("figure", *counts, "together", "95 %"), rows)


def rounds_csv(rounds: Mapping[str, Sequence[Mapping[str, Any]]]) -> str:
    """Return the figures of each round as CSV: value, counts where it is a rate, and its exact 95 % interval."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(("round", "cases", "figure", "value", "hits", "of", "low_95", "high_95"))
    for name, cases in rounds.items():
        for label, value in [*((m.label, m.value) for m in compute_targets(cases)), *compute_further_rates(cases)]:
            numbers: tuple[Any, ...] = (value, None, None, None, None)
            if isinstance(value, Rate):
                numbers = (value.share, value.hits, value.of, *(value.bounds or (None, None)))
            digits = ["" if n is None else f"{n:.4g}" for n in numbers]
            writer.writerow((name, len(cases), label, *digits))
    return file.getvalue()


def tabulate_effects(cases: Sequence[Mapping[str, Any]]) -> str:
    """Return Markdown with the rates of each single effect."""
    rows = [
        (name, *(f"{r.hits} of {r.of}" if r.of else NO_VALUE for r in rates))
        for name, rates in hidden_rates.by_effect(cases).items()
    ]
    return _markdown_table(
        ("one effect, class identified", "half its typical size", "typical", "1.5", "of all that show"), rows
    )


def _format_figures(cases: Sequence[Mapping[str, Any]]) -> dict[str, tuple[str, str]]:
    """Return (figure, bounds) by label."""
    values = [*((m.label, m.value) for m in compute_targets(cases)), *compute_further_rates(cases)]
    return {label: _format_figure(label, value) for label, value in values}


def _format_figure(label: str, value: Rate | float | None) -> tuple[str, str]:
    point, bounds, count = _format_value(value, label.startswith("mean size") or label.endswith("a case"))
    return (f"{value.hits} of {count}" if isinstance(value, Rate) and value.of else point), bounds


def describe_durations(cases: Sequence[Mapping[str, Any]]) -> str:
    """Return a line about the duration of the diagnoses."""
    spent = [c["seconds"] for c in cases if c["seconds"] is not None]
    if not cases:
        return "no case is finished"
    count = f"{len(cases)} cases, {sum(c['sealed'] for c in cases)} of them sealed"
    if not spent:
        return f"every diagnosis was stopped and resumed, so its duration is not known, {count}"
    fast = sum(t <= MAX_DIAGNOSIS_S for t in spent)
    return (
        f"{np.median(spent):.0f} s a diagnosis (median; longest {max(spent):.0f} s; {fast} of {len(spent)} within "
        f"{MAX_DIAGNOSIS_S / 60:.0f} minutes; cases that run at the same time slow it down), "
        f"{count}"
    )


def _target_row(m: Target) -> tuple[str, ...]:
    sign, count = "≥" if m.is_minimum else "≤", m.label.startswith("mean size")
    must, aim = (f"{sign} {x:g}" if count else f"{sign} {format_percent(x)}" for x in (m.must, m.aim))
    return (m.label, must, aim, *_format_value(m.value, count), m.reached)


def _rate_row(label: str, value: Rate | float | None) -> tuple[str, ...]:
    return (label, *_format_value(value, label.endswith("a case")))


def _format_value(value: Rate | float | None, count: bool = False) -> tuple[str, str, str]:
    """Return (point estimate, bounds, number of cases)."""
    if isinstance(value, Rate):
        bounds = NO_VALUE if value.bounds is None else "{}–{}".format(*map(format_percent, value.bounds))
        return format_percent(value.share), bounds, str(value.of)
    return (NO_VALUE if value is None else f"{value:.2f}" if count else format_percent(value)), "", ""


def format_percent(share: float | None) -> str:
    """Return whole per cent."""
    return NO_VALUE if share is None else f"{100 * share:.0f} %"


CASE_COLUMNS = ("case", "family", "kind", "hidden", "verdict", "named", "", "amplitude", "gain", "s")


def _case_row(c: Mapping[str, Any]) -> tuple[str, ...]:
    off = [f"{100 * a['error']:+.0f} %" for a in c.get("amplitudes", ()) if a is not None]
    gain = "" if c.get("gain") is None else f"{c['gain']:.2f}"
    named = ", ".join(c["named"]) or NO_VALUE
    outcome = "right" if c["right"] else "alarm" if c["family"] in NULL_FAMILIES and c["named"] else "missed"
    outcome += ", false cause" if c["wrong"] and outcome != "alarm" else ""
    hidden = ", ".join(c["hidden"]) or NO_VALUE
    first = (c["name"], c["family"], c["kind"], hidden, c["verdict"], named, outcome)
    return (*first, ", ".join(off), gain, NO_VALUE if c["seconds"] is None else f"{c['seconds']:.0f}")


def _fill_table(title: str, headings: Sequence[str], rows: Sequence[Sequence[str]], left: int = 1):
    out = make_table(title, *headings, left=left)
    for column in out.columns:
        column.no_wrap = False
    for row in rows:
        out.add_row(*row)
    return out


def _markdown_table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    table = [headings, ["---"] * len(headings), *([cell.replace("|", "or") for cell in row] for row in rows)]
    return "\n".join("| " + " | ".join(row) + " |" for row in table)
