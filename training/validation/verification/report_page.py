"""The page docs/validation/verification.md: the figures of the table, the sources of the truth, and pictures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from .assessment import UNMET_VERDICTS, TableLine
from .registry import Case

PAGE_HEAD = """# Verification

`make verify` measures all figures of this page and writes it. It fails when a figure misses its tolerance. The truth
comes from outside the simulator: closed forms, symmetry, conservation, finite differences, and for convergence the same
scene on a finer discretisation. Figures are in float64 on one CPU core unless the case says otherwise. Errors below a
thousandth of a tolerance are not resolved. Where a sheet crumples, the last digits may differ between machines.

Tolerances are those of the design unless the case says otherwise. A *finding* is reported without a tolerance.
*Failed*: the case gave no figure.

"""
THEME_TITLES = {
    "gradients": "Forces and gradients",
    "symmetry": "Symmetry and conservation",
    "elasticity": "Elasticity",
    "bending": "Bending",
    "dynamics": "Motion",
    "contact": "Contact between layers",
    "folding": "Folding at the size of a garment",
    "plasticity": "Plastic set",
    "convergence": "Convergence",
}


class CaseReport(NamedTuple):
    """What the page shows of one case.

    Attributes:
        case: the case.
        note: what a reader of the figures must know.
        lines: of the table.
        has_picture: verification/NAME.png exists.
    """

    case: Case
    note: str
    lines: list[TableLine]
    has_picture: bool


def write_page(reports: Sequence[CaseReport], folder: Path) -> None:
    """Write ``folder``/verification.md, which shows ``folder``/verification/NAME.png."""
    parts = [PAGE_HEAD, _summary(reports)]
    theme = None
    for report in reports:
        case = report.case
        if case.theme != theme:
            theme = case.theme
            parts.append(f"## {THEME_TITLES.get(theme, theme)}\n\n")
        parts.append(_section(report))
    (folder / "verification.md").write_text("".join(parts).rstrip() + "\n", encoding="utf-8")


def _summary(reports: Sequence[CaseReport]) -> str:
    lines = [line for report in reports for line in report.lines]
    assessed = [line for line in lines if line.verdict != "finding"]
    missed = [line for line in assessed if line.verdict in UNMET_VERDICTS]
    text = f"{len(assessed) - len(missed)} of {len(assessed)} figures in {len(reports)} cases meet their tolerances"
    if not missed:
        return text + ".\n\n"
    items = [f"- `{line.case}`, {line.label}: {line.verdict}" + _describe_miss(line) for line in missed]
    return text + "; these do not:\n\n" + "\n".join(items) + "\n\n"


def _describe_miss(line: TableLine) -> str:
    if line.verdict != "missed":
        return ""
    if line.tolerance == "–":
        return f", {line.measured}, required {line.truth}"
    return f", error {line.error}, tolerance {line.tolerance}"


def _section(report: CaseReport) -> str:
    case = report.case
    out = [f"### {case.title}\n\n`{case.name}`. Truth: {case.truth}.\n"]
    out.append("\n|  | measured | truth | error | tolerance |  |\n|---|---|---|---|---|---|\n")
    for line in report.lines:
        verdict = f"**{line.verdict}**" if line.verdict in UNMET_VERDICTS else line.verdict
        cells = (line.label, line.measured, line.truth, line.error, line.tolerance, verdict)
        out.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |\n")
    if report.note:
        out.append(f"\n{report.note}\n")
    if report.has_picture:
        out.append(f"\n![{case.title}](verification/{case.name}.png)\n")
    return "".join(out) + "\n"
