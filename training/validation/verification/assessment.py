"""Assess figures against tolerances, and format numbers so that they are the same on every machine."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from .registry import Case, Outcome, Row, Tolerance

Verdict = Literal["pass", "missed", "failed", "finding"]
UNMET_VERDICTS: tuple[Verdict, ...] = ("missed", "failed")
MIN_PRINTED_TOLERANCE = 1e-4  # errors below a smaller tolerance are rounding: only their power of ten is printed
PRINTED_FLOOR_DIVISOR = 1e3  # errors below the tolerance over this number are all printed alike


@dataclass(frozen=True)
class TableLine:
    """One line of the table, as text.

    Attributes:
        case: name of the case.
        label: says what was measured.
        measured: value with unit.
        truth: value with unit.
        error: of the measured value.
        tolerance: of the error.
        verdict: whether the tolerance is met.
    """

    case: str
    label: str
    measured: str
    truth: str
    error: str
    tolerance: str
    verdict: Verdict


def assess_outcome(case: Case, outcome: Outcome) -> list[TableLine]:
    """Return the lines of a case's rows, with verdicts."""
    return [_assess_row(case, row) for row in outcome.rows]


def failed_line(case: Case, message: str) -> list[TableLine]:
    """Return the line of a case that gave no figures."""
    return [TableLine(case.name, message, "–", "–", "–", "–", "failed")]


def _assess_row(case: Case, row: Row) -> TableLine:
    tolerance = row.tolerance or case.tolerance
    if row.finding or tolerance is None or row.truth is None:
        truth = "–" if row.truth is None else _format_quantity(row.truth, row.unit)
        return TableLine(case.name, row.label, _format_quantity(row.measured, row.unit), truth, "–", "–", "finding")
    error = tolerance.error(row.measured, row.truth)
    verdict: Verdict = "pass" if error <= tolerance.limit else "missed"
    is_bound = tolerance.kind in ("at most", "at least")
    sign = {"at most": "≤ ", "at least": "≥ "}.get(tolerance.kind, "")
    measured = row.measured if row.truth or is_bound else error
    is_zero_truth = row.truth == 0 and not is_bound
    return TableLine(
        case.name,
        row.label,
        _format_small(measured, tolerance, row.unit) if is_zero_truth else _format_quantity(row.measured, row.unit),
        sign + _format_quantity(row.truth, row.unit),
        _format_error(error, tolerance, row.unit),
        "–" if is_bound and tolerance.limit == 0 else "≤ " + _format_fraction(tolerance.limit, tolerance, row.unit),
        verdict,
    )


def _format_error(error: float, tolerance: Tolerance, unit: str) -> str:
    if tolerance.kind in ("at most", "at least"):
        return "none" if error == 0 else _format_quantity(error, unit)
    if tolerance.kind == "absolute":
        return _format_small(error, tolerance, unit)
    if tolerance.limit < MIN_PRINTED_TOLERANCE:
        return _format_small(error, tolerance, "")
    return _format_fraction(error, tolerance, unit)


def _format_fraction(value: float, tolerance: Tolerance, unit: str) -> str:
    if tolerance.kind != "relative":
        return _format_quantity(value, unit)
    return f"{100 * value:.2g} %" if tolerance.limit >= MIN_PRINTED_TOLERANCE else f"{value:.0e}"


def _format_small(value: float, tolerance: Tolerance, unit: str) -> str:
    """Format a value that may be rounding, which differs between machines, by a bound of its power of ten."""
    if tolerance.limit >= MIN_PRINTED_TOLERANCE or not math.isfinite(value):
        return _format_quantity(value, unit)
    floor = tolerance.limit / PRINTED_FLOOR_DIVISOR
    bound = floor if value <= floor else 10.0 ** math.ceil(math.log10(value))
    return f"< {bound:.0e} {unit}".strip()


def _format_quantity(value: float, unit: str) -> str:
    number = "0" if value == 0 else f"{value:.3g}" if abs(value) < 1 else f"{value:.4g}"
    return f"{number} {unit}".strip()
