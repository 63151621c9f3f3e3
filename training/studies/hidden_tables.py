"""The hidden round as tables: for a terminal, and as Markdown for the docs."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from . import hidden_rates
from .fabric_tables import NO_VALUE, make_table
from .hidden_rates import Mark, Rate, further, marks
from .hidden_scores import NULLS

LONG = 240.0  # s, that a diagnosis of this size may take
HEADINGS = ("figure", "must", "aim", "is", "95 %", "of", "")


def show(cases: Sequence[Mapping[str, Any]]) -> None:
    """Marks, further rates, and every case."""
    from rich.console import Console

    console = Console(highlight=False)
    console.width = max(console.width, 130)
    console.print(_filled("What must show", HEADINGS, [_mark(m) for m in marks(cases)]))
    console.print(_filled("Further", ("figure", "is", "95 %", "of"), [_rate(*row) for row in further(cases)]))
    console.print(_filled("Every case", CASE, [_case(c) for c in cases], left=7))
    console.print(seconds(cases), markup=False)


def markdown(cases: Sequence[Mapping[str, Any]]) -> str:
    """The same, to be pasted."""
    parts = [
        _lines(HEADINGS, [_mark(m) for m in marks(cases)]),
        _lines(("figure", "is", "95 %", "of"), [_rate(*row) for row in further(cases)]),
        _lines(CASE, [_case(c) for c in cases]),
    ]
    return "\n\n".join(parts) + f"\n\n{seconds(cases)}\n"


def beside(rounds: Mapping[str, Sequence[Mapping[str, Any]]]) -> str:
    """Markdown with a column for each round, with its number of cases, and one for all their cases together."""
    columns = [_figures(cases) for cases in (*rounds.values(), [c for cases in rounds.values() for c in cases])]
    rows = [(label, *(c[label][0] for c in columns), columns[-1][label][1]) for label in columns[-1]]
    counts = [f"{name} ({len(cases)})" for name, cases in rounds.items()]
    return _lines(("figure", *counts, "together", "95 %"), rows)


def rounds_csv(rounds: Mapping[str, Sequence[Mapping[str, Any]]]) -> str:
    """Return the figures of each round as CSV: value, counts where it is a rate, and its exact 95 % interval."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(("round", "cases", "figure", "value", "hits", "of", "low_95", "high_95"))
    for name, cases in rounds.items():
        for label, value in [*((m.label, m.value) for m in marks(cases)), *further(cases)]:
            numbers: tuple[Any, ...] = (value, None, None, None, None)
            if isinstance(value, Rate):
                numbers = (value.share, value.hits, value.of, *(value.bounds or (None, None)))
            digits = ["" if n is None else f"{n:.4g}" for n in numbers]
            writer.writerow((name, len(cases), label, *digits))
    return file.getvalue()


def by_effect(cases: Sequence[Mapping[str, Any]]) -> str:
    """Markdown with the singles of each effect."""
    said = lambda r: f"{r.hits} of {r.of}" if r.of else NO_VALUE  # noqa: E731
    rows = [(name, *map(said, rates)) for name, rates in hidden_rates.by_effect(cases).items()]
    return _lines(("one effect, class identified", "half its typical size", "typical", "1.5", "of all that show"), rows)


def _figures(cases: Sequence[Mapping[str, Any]]) -> dict[str, tuple[str, str]]:
    """(figure, bounds) by its label."""
    values = [*((m.label, m.value) for m in marks(cases)), *further(cases)]
    return {label: _figure(label, value) for label, value in values}


def _figure(label: str, value: Rate | float | None) -> tuple[str, str]:
    point, bounds, count = _value(value, label.startswith("mean size") or label.endswith("a case"))
    return (f"{value.hits} of {count}" if isinstance(value, Rate) and value.of else point), bounds


def seconds(cases: Sequence[Mapping[str, Any]]) -> str:
    """What a case costs."""
    spent = [c["seconds"] for c in cases if c["seconds"] is not None]
    if not cases:
        return "no case is finished"
    count = f"{len(cases)} cases, {sum(c['sealed'] for c in cases)} of them sealed"
    if not spent:
        return f"every diagnosis was stopped on its way, so that what it took is not known, {count}"
    return (
        f"{np.median(spent):.0f} s a diagnosis (median; longest {max(spent):.0f} s; {sum(t <= LONG for t in spent)} of "
        f"{len(spent)} within {LONG / 60:.0f} minutes; cases that run beside it slow it down), {count}"
    )


def _mark(m: Mark) -> tuple[str, ...]:
    sign, count = "≥" if m.least else "≤", m.label.startswith("mean size")
    must, aim = (f"{sign} {x:g}" if count else f"{sign} {percent(x)}" for x in (m.must, m.aim))
    return (m.label, must, aim, *_value(m.value, count), m.reached)


def _rate(label: str, value: Rate | float | None) -> tuple[str, ...]:
    return (label, *_value(value, label.endswith("a case")))


def _value(value: Rate | float | None, count: bool = False) -> tuple[str, str, str]:
    """(point, bounds, number of cases)."""
    if isinstance(value, Rate):
        bounds = NO_VALUE if value.bounds is None else "{}–{}".format(*map(percent, value.bounds))
        return percent(value.share), bounds, str(value.of)
    return (NO_VALUE if value is None else f"{value:.2f}" if count else percent(value)), "", ""


def percent(share: float | None) -> str:
    """Whole per cents."""
    return NO_VALUE if share is None else f"{100 * share:.0f} %"


CASE = ("case", "family", "kind", "hidden", "verdict", "named", "", "amplitude", "gain", "s")


def _case(c: Mapping[str, Any]) -> tuple[str, ...]:
    off = [f"{100 * a['error']:+.0f} %" for a in c.get("amplitudes", ()) if a is not None]
    gain = "" if c.get("gain") is None else f"{c['gain']:.2f}"
    named = ", ".join(c["named"]) or NO_VALUE
    said = "right" if c["right"] else "alarm" if c["family"] in NULLS and c["named"] else "missed"
    said += ", false cause" if c["wrong"] and said != "alarm" else ""
    hidden = ", ".join(c["hidden"]) or NO_VALUE
    first = (c["name"], c["family"], c["kind"], hidden, c["verdict"], named, said)
    return (*first, ", ".join(off), gain, NO_VALUE if c["seconds"] is None else f"{c['seconds']:.0f}")


def _filled(title: str, headings: Sequence[str], rows: Sequence[Sequence[str]], left: int = 1):
    out = make_table(title, *headings, left=left)
    for column in out.columns:
        column.no_wrap = False
    for row in rows:
        out.add_row(*row)
    return out


def _lines(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    table = [headings, ["---"] * len(headings), *([cell.replace("|", "or") for cell in row] for row in rows)]
    return "\n".join("| " + " | ".join(row) + " |" for row in table)
