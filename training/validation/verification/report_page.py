"""docs/verification.md: the same figures as the table, with where the truth comes from and pictures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from .assessment import OPEN, Line
from .registry import Case

HEAD = """# Verification

`make verify` measures what stands here and writes this page; it fails when a figure misses its mark. Truth comes
from outside the simulator: closed forms, symmetry, conservation, finite differences, and for convergence the same scene
computed finer. Figures are in float64 on one CPU core unless the case says otherwise; below a thousandth of the mark
only that is said, and where a sheet crumples the last digits may differ between machines.

Marks are those that the design set, unless the case says otherwise; a *finding* is reported and has no mark.
*Absent*: what the case measures is not built yet; *failed*: the case gave no figure. Both count as missed.

"""
THEMES = {
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
Found = tuple[Case, str, list[Line], bool]


def write(found: Sequence[Found], folder: Path) -> None:
    """Write verification.md into ``folder``, beside verification/NAME.png."""
    parts = [HEAD, _summary(found)]
    theme = None
    for case, note, rows, picture in found:
        if case.theme != theme:
            theme = case.theme
            parts.append(f"## {THEMES.get(theme, theme)}\n\n")
        parts.append(_section(case, note, rows, picture))
    (folder / "verification.md").write_text("".join(parts).rstrip() + "\n", encoding="utf-8")


def _summary(found: Sequence[Found]) -> str:
    lines = [line for _, _, rows, _ in found for line in rows]
    judged = [line for line in lines if line.verdict != "finding"]
    missed = [line for line in judged if line.verdict in OPEN]
    text = f"{len(judged) - len(missed)} of {len(judged)} figures in {len(found)} cases meet their marks"
    if not missed:
        return text + ".\n\n"
    items = [f"- `{line.case}`, {line.label}: {line.verdict}" + _reached(line) for line in missed]
    return text + "; these do not:\n\n" + "\n".join(items) + "\n\n"


def _reached(line: Line) -> str:
    if line.verdict != "missed":
        return ""
    if line.mark == "–":
        return f", {line.measured} where {line.truth} is asked"
    return f", error {line.error} where {line.mark} is asked"


def _section(case: Case, note: str, rows: Sequence[Line], picture: bool) -> str:
    out = [f"### {case.title}\n\n`{case.name}`. Truth: {case.truth}.\n"]
    out.append("\n|  | measured | truth | error | mark |  |\n|---|---|---|---|---|---|\n")
    for line in rows:
        verdict = f"**{line.verdict}**" if line.verdict in OPEN else line.verdict
        cells = (line.label, line.measured, line.truth, line.error, line.mark, verdict)
        out.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |\n")
    if note:
        out.append(f"\n{note}\n")
    if picture:
        out.append(f"\n![{case.title}](verification/{case.name}.png)\n")
    return "".join(out) + "\n"
