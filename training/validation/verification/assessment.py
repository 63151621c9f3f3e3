"""Figures against marks, and how numbers are written: alike on every machine, as far as physics decides them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from .registry import Case, Mark, Outcome, Row

Verdict = Literal["pass", "missed", "absent", "failed", "finding"]
OPEN: tuple[Verdict, ...] = ("missed", "absent", "failed")


@dataclass(frozen=True)
class Line:
    """One line of the table, in words."""

    case: str
    label: str
    measured: str
    truth: str
    error: str
    mark: str
    verdict: Verdict


def lines(case: Case, outcome: Outcome) -> list[Line]:
    """The case's rows, judged."""
    return [_line(case, row) for row in outcome.rows]


def unfinished(case: Case, verdict: Verdict, message: str) -> list[Line]:
    """The line of a case that gave no figures."""
    return [Line(case.name, message, "–", "–", "–", "–", verdict)]


def _line(case: Case, row: Row) -> Line:
    mark = row.mark or case.mark
    if row.finding or mark is None or row.truth is None:
        truth = "–" if row.truth is None else _quantity(row.truth, row.unit)
        return Line(case.name, row.label, _quantity(row.measured, row.unit), truth, "–", "–", "finding")
    error = mark.error(row.measured, row.truth)
    verdict: Verdict = "pass" if error <= mark.limit else "missed"
    bound = mark.kind in ("at most", "at least")
    sign = {"at most": "≤ ", "at least": "≥ "}.get(mark.kind, "")
    measured = row.measured if row.truth or bound else error
    return Line(
        case.name,
        row.label,
        _tiny(measured, mark, row.unit) if row.truth == 0 and not bound else _quantity(row.measured, row.unit),
        sign + _quantity(row.truth, row.unit),
        _error(error, mark, row.unit),
        "–" if bound and mark.limit == 0 else "≤ " + _share(mark.limit, mark, row.unit),
        verdict,
    )


def _error(error: float, mark: Mark, unit: str) -> str:
    if mark.kind in ("at most", "at least"):
        return "none" if error == 0 else _quantity(error, unit)
    if mark.kind == "absolute":
        return _tiny(error, mark, unit)
    return _tiny(error, mark, "") if mark.limit < 1e-4 else _share(error, mark, unit)


def _share(value: float, mark: Mark, unit: str) -> str:
    if mark.kind != "relative":
        return _quantity(value, unit)
    return f"{100 * value:.2g} %" if mark.limit >= 1e-4 else f"{value:.0e}"


def _tiny(value: float, mark: Mark, unit: str) -> str:
    """Rounding is not the same on every machine: only its power of ten is written, and nothing far below the mark."""
    if mark.limit >= 1e-4 or not math.isfinite(value):
        return _quantity(value, unit)
    floor = mark.limit / 1e3
    above = floor if value <= floor else 10.0 ** math.ceil(math.log10(value))
    return f"< {above:.0e} {unit}".strip()


def _quantity(value: float, unit: str) -> str:
    number = "0" if value == 0 else f"{value:.3g}" if abs(value) < 1 else f"{value:.4g}"
    return f"{number} {unit}".strip()
