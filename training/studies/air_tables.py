"""Tables and a figure of the air study."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from torchcloth._utils.constants import Z_95
from torchcloth._utils.files import save_figure
from torchcloth.identification.pictures import AFTER_COLOUR, NULL_COLOUR

from .fabric_tables import make_table

MODEL_LABELS = {
    "measured": "measured",
    "still": "nodes before the motion",
    "null": "null: carried rigidly",
    "before": "base models, in vacuum",
    "after": "with the causes named",
}
MASS_CAUSE = "mass.density"


def first_cause(answer: dict[str, Any]) -> str:
    """Return the cause that a group names first; empty if there is none."""
    return answer["causes"][0]["effect"] if answer["causes"] else ""


def _label_group(answer: dict[str, Any]) -> str:
    """Return all causes of a group, with its first run."""
    causes = ", ".join(c["effect"] for c in answer["causes"]) or "none named"
    return f"{causes} (group of {answer['runs'][0].replace('range', '').replace('_rep', '/')})"


def show(result: dict[str, Any]) -> None:
    """Print the tables and their summary."""
    from rich.console import Console
    from rich.markup import escape

    answers = result["groups"].values()
    table_rows = make_table(
        f"IRI swings from vacuum, {next(iter(answers))['asked']} causes asked about",
        "runs", "verdict", "cause", "confounded with", "amplitude (95 %)", "rms mm, held out", left=4,
    )  # fmt: skip
    for answer in answers:
        _rows(table_rows, answer)
    console = Console(highlight=False)
    console.width = max(console.width, 150)
    console.print(table_rows)
    air = sum(first_cause(a).startswith("air.") for a in answers)
    unresolvable_groups = sum(any(r["effect"] == MASS_CAUSE for r in a["unresolvable"]) for a in answers)
    console.print(
        f"air is named before any other cause in {air} of {len(answers)} groups, another cause in "
        f"{sum(bool(first_cause(a)) for a in answers) - air}"
    )
    if unresolvable_groups:
        console.print(
            f"the mass itself is not identifiable: {MASS_CAUSE} is unresolvable in {unresolvable_groups} groups; only "
            "ratios to it are identifiable"
        )
    table_rows = make_table(
        f"{len(result['predicted_runs'])} whole runs that none was fitted to; 95 %", *PREDICTION_HEADINGS, left=1
    )
    rows = [(label, result["predicted"][key]) for key, label in MODEL_LABELS.items()]
    rows += [
        (f"  {_label_group(a)}", row) for a, row in zip(answers, result["predicted"]["after"]["groups"], strict=True)
    ]
    for label, row in rows:
        table_rows.add_row(escape(label), *(_estimate(row, name, *how) for name, how in QUANTITY_FORMAT.items()))
    console.print(table_rows)
    console.print(
        "Intervals: bootstrap over the runs and, for means, the scatter between groups. decay: B in A' = -B A^2 for "
        "the amplitude A."
    )


PREDICTION_HEADINGS = ("", "node rms mm", "swing Hz", "decay 1/(m s)")
QUANTITY_FORMAT = {"rms": (1e3, 1), "frequency": (1.0, 3), "decay": (1.0, 1)}  # factor, digits


def _rows(table_rows: Any, answer: dict[str, Any]) -> None:
    from rich.markup import escape

    runs = ", ".join(name.replace("range", "").replace("_rep", "/") for name in answer["runs"])
    gain = answer["gain"]
    rms_text = f"{1e3 * gain['rms_before']:.1f} > {1e3 * gain['rms_after']:.1f}" if gain else ""
    for k, cause in enumerate(answer["causes"]):
        others = {*cause["equivalence_class"], *(r["effect"] for r in cause["rivals"])} - {cause["effect"]}
        size = f"{cause['amplitude']:.3g} ({cause['ci95'][0]:.3g} to {cause['ci95'][1]:.3g}) {cause['unit']}"
        head = ["", "", ""] if k else [runs, answer["verdict"], rms_text]
        table_rows.add_row(*head[:2], escape(cause["effect"]), escape(", ".join(sorted(others))), size, head[2])
    if not answer["causes"]:
        table_rows.add_row(runs, answer["verdict"], "", "", "", "")


def _estimate(row: dict[str, Any], key: str, factor: float, digits: int) -> str:
    if key not in row:
        return ""
    value, wide = factor * row[key], Z_95 * factor * row[f"{key}_std"]
    if not wide:  # one run
        return f"{value:.{digits}f}"
    return f"{value:.{digits}f} ({value - wide:.{digits}f} to {value + wide:.{digits}f})"


def draw(result: dict[str, Any], runs: dict[str, dict[str, Any]], path: Path) -> Path:
    """Draw the distances of each run without and with the causes, and frequency and decay with the measured ones."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 4.2), layout="constrained")
    axes, colours = figure.subplots(1, 3), {"before": NULL_COLOUR, "after": AFTER_COLOUR}
    groups = list(result["groups"])
    for when, colour in colours.items():
        rms = [
            [1e3 * np.sqrt(r[f"{when} {g}"]["squares"] / r[f"{when} {g}"]["count"]) for g in groups]
            for r in runs.values()
        ]
        for k, group_values in enumerate(rms):
            axes[0].plot(
                [k] * len(group_values),
                group_values,
                "o",
                color=colour,
                ms=4,
                alpha=0.7,
                label=None if k else MODEL_LABELS[when],
            )
    axes[0].set_xticks(
        range(len(runs)), [n.replace("range", "").replace("_rep", "/") for n in runs], rotation=60, fontsize=8
    )
    axes[0].set(ylabel="node rms [mm]", ylim=(0, None), title="held-out runs, a dot for each group's model")
    axes[0].legend(fontsize=8)
    for axis, key, label in zip(axes[1:], ("frequency", "decay"), ("swing [Hz]", "decay B [1/(m s)]"), strict=True):
        shown = [name for name in MODEL_LABELS if key in result["predicted"][name]]
        for k, name in enumerate(shown):
            row = result["predicted"][name]
            colour = colours.get(name, "black")
            axis.errorbar(row[key], -k, xerr=Z_95 * row[f"{key}_std"], fmt="o", color=colour, capsize=3)
            group_values = [g[key] for g in row.get("groups", ())]
            axis.plot(group_values, [-k - 0.15] * len(group_values), ".", color=colour, ms=4)
        axis.axvline(result["predicted"]["measured"][key], color="black", lw=0.5)
        axis.set_yticks(
            [-k for k in range(len(shown))], [MODEL_LABELS[n].replace(", ", ",\n") for n in shown], fontsize=8
        )
        axis.set(xlabel=label, title="free swings after the stop", ylim=(0.5 - len(shown), 0.5))
    return save_figure(figure, path)
