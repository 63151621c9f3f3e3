"""What diagnoses of real swings said, and what they mend: tables and a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from torchcloth.identification.pictures import AFTER, NULL, save_figure

from .fabric_tables import table

NORMAL = 1.96
LABELS = {
    "measured": "measured",
    "still": "nodes before the motion",
    "null": "null: carried rigidly",
    "before": "base models, in vacuum",
    "after": "with the causes named",
}
MASS = "mass.density"


def first(answer: dict[str, Any]) -> str:
    """The cause that a group names first; empty if none."""
    return answer["causes"][0]["effect"] if answer["causes"] else ""


def _named(answer: dict[str, Any]) -> str:
    """All causes of a group with its first run."""
    causes = ", ".join(c["effect"] for c in answer["causes"]) or "none named"
    return f"{causes} (group of {answer['runs'][0].replace('range', '').replace('_rep', '/')})"


def show(found: dict[str, Any]) -> None:
    """As tables, with what they say."""
    from rich.console import Console
    from rich.markup import escape

    answers = found["groups"].values()
    filled = table(
        f"IRI swings from vacuum, {next(iter(answers))['asked']} causes asked about",
        "runs", "verdict", "cause", "cannot be told from", "amplitude (95 %)", "rms mm, held out", left=4,
    )  # fmt: skip
    for answer in answers:
        _rows(filled, answer)
    console = Console(highlight=False)
    console.width = max(console.width, 150)
    console.print(filled)
    air = sum(first(a).startswith("air.") for a in answers)
    unseen = sum(any(r["effect"] == MASS for r in a["unresolvable"]) for a in answers)
    console.print(
        f"air is named before any other cause in {air} of {len(answers)} groups, another cause in "
        f"{sum(bool(first(a)) for a in answers) - air}"
    )
    if unseen:
        console.print(f"mass itself cannot be told: {MASS} cannot be seen in {unseen} groups, only ratios to it can")
    filled = table(f"{len(found['predicted_runs'])} whole runs that none was fitted to; 95 %", *HEADINGS, left=1)
    rows = [(label, found["predicted"][key]) for key, label in LABELS.items()]
    rows += [(f"  {_named(a)}", row) for a, row in zip(answers, found["predicted"]["after"]["groups"], strict=True)]
    for label, row in rows:
        filled.add_row(escape(label), *(_estimate(row, name, *how) for name, how in QUANTITIES.items()))
    console.print(filled)
    console.print(
        "by drawing the runs again and, of means, what groups differ by. decay: B of A' = -B A^2 of the amplitude A"
    )


HEADINGS = ("", "node rms mm", "swing Hz", "decay 1/(m s)")
QUANTITIES = {"rms": (1e3, 1), "frequency": (1.0, 3), "decay": (1.0, 1)}  # factor, digits


def _rows(filled: Any, answer: dict[str, Any]) -> None:
    from rich.markup import escape

    runs = ", ".join(name.replace("range", "").replace("_rep", "/") for name in answer["runs"])
    gain = answer["gain"]
    held = f"{1e3 * gain['rms_before']:.1f} > {1e3 * gain['rms_after']:.1f}" if gain else ""
    for k, cause in enumerate(answer["causes"]):
        others = {*cause["class"], *(r["effect"] for r in cause["rivals"])} - {cause["effect"]}
        size = f"{cause['amplitude']:.3g} ({cause['ci95'][0]:.3g} to {cause['ci95'][1]:.3g}) {cause['unit']}"
        head = ["", "", ""] if k else [runs, answer["verdict"], held]
        filled.add_row(*head[:2], escape(cause["effect"]), escape(", ".join(sorted(others))), size, head[2])
    if not answer["causes"]:
        filled.add_row(runs, answer["verdict"], "", "", "", "")


def _estimate(row: dict[str, Any], key: str, factor: float, digits: int) -> str:
    if key not in row:
        return ""
    value, wide = factor * row[key], NORMAL * factor * row[f"{key}_std"]
    if not wide:  # one run
        return f"{value:.{digits}f}"
    return f"{value:.{digits}f} ({value - wide:.{digits}f} to {value + wide:.{digits}f})"


def draw(found: dict[str, Any], runs: dict[str, dict[str, Any]], path: Path) -> Path:
    """Distances of every run before and after; frequency and decay beside the measured ones."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 4.2), layout="constrained")
    axes, tints = figure.subplots(1, 3), {"before": NULL, "after": AFTER}
    groups = list(found["groups"])
    for when, tint in tints.items():
        rms = [
            [1e3 * np.sqrt(r[f"{when} {g}"]["squares"] / r[f"{when} {g}"]["count"]) for g in groups]
            for r in runs.values()
        ]
        for k, own in enumerate(rms):
            axes[0].plot([k] * len(own), own, "o", color=tint, ms=4, alpha=0.7, label=None if k else LABELS[when])
    axes[0].set_xticks(
        range(len(runs)), [n.replace("range", "").replace("_rep", "/") for n in runs], rotation=60, fontsize=8
    )
    axes[0].set(ylabel="node rms [mm]", ylim=(0, None), title="held-out runs, a dot for each group's model")
    axes[0].legend(fontsize=8)
    for axis, key, label in zip(axes[1:], ("frequency", "decay"), ("swing [Hz]", "decay B [1/(m s)]"), strict=True):
        shown = [name for name in LABELS if key in found["predicted"][name]]
        for k, name in enumerate(shown):
            row = found["predicted"][name]
            tint = tints.get(name, "black")
            axis.errorbar(row[key], -k, xerr=NORMAL * row[f"{key}_std"], fmt="o", color=tint, capsize=3)
            own = [g[key] for g in row.get("groups", ())]
            axis.plot(own, [-k - 0.15] * len(own), ".", color=tint, ms=4)
        axis.axvline(found["predicted"]["measured"][key], color="black", lw=0.5)
        axis.set_yticks([-k for k in range(len(shown))], [LABELS[n].replace(", ", ",\n") for n in shown], fontsize=8)
        axis.set(xlabel=label, title="free swings after the stop", ylim=(0.5 - len(shown), 0.5))
    return save_figure(figure, path)
