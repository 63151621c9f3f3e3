"""Print a pose estimate as a table for a terminal."""

from __future__ import annotations

import math

from .result import PoseEstimate

MIN_POSE_TABLE_COLUMNS = 100  # of the terminal
DISTANCE_ROW_LABELS = {
    "null": "null: carried rigidly",
    "uncorrected": "simulated, no correction",
    "after": "estimate",
}


def print_pose(estimate: PoseEstimate) -> None:
    """Print distances, errors, the corrective force and warnings."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    console, fit = Console(highlight=False), estimate.fit
    console.width = max(console.width, MIN_POSE_TABLE_COLUMNS)
    table = Table(title="Distance cloud to surface, one-sided, mm", title_justify="left", box=box.SIMPLE_HEAD)
    for heading in ("", "Chamfer", "rms"):
        table.add_column(heading, justify="right" if heading else "left", no_wrap=True)
    for key, label in DISTANCE_ROW_LABELS.items():
        numbers = (1e3 * fit[f"{what}_{key}"] for what in ("chamfer", "rms"))
        table.add_row(label, *("–" if math.isnan(number) else f"{number:.2f}" for number in numbers))
    console.print(table)
    squared = estimate.std.square().sum(-1)
    parts = (("seen", estimate.seen), ("hidden", ~estimate.seen))
    errors = [f"{name} {1e3 * float(squared[rows].mean().sqrt()):.1f} mm" for name, rows in parts if bool(rows.any())]
    console.print(f"standard error of a vertex, rms: {', '.join(errors)}; {100 * fit['seen_fraction']:.0f} % were seen")
    console.print(
        f"corrective force: {100 * fit['force_fraction']:.1f} % of the weight (rms), at most "
        f"{100 * fit['force_fraction_max']:.1f} % in one of {len(estimate.force_fractions)} windows; "
        f"{fit['seconds']:.0f} s"
    )
    for name, e in {**estimate.parameters, **estimate.nuisances}.items():
        console.print(f"{name}: {e.value:.4g} ± {e.std:.2g} {e.unit}", markup=False)
    for warning in estimate.warnings:
        console.print(f"note: {warning}", style="yellow", markup=False)
