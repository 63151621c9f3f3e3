"""A motion plan as a table for a terminal."""

from __future__ import annotations

from .result import MotionPlan


def print_plan(plan: MotionPlan) -> None:
    """Print distances, path changes, the nearest limit and warnings."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    console = Console(highlight=False)
    console.width = max(console.width, 100)
    table = Table(title_justify="left", box=box.SIMPLE_HEAD)
    several = len(plan.distance_after) > 1
    headings = ("mean of the models [mm]", "least", "most") if several else ("from the goal at the end [mm]",)
    for heading in ("", *headings):
        table.add_column(heading, justify="right" if heading else "left", no_wrap=True)
    for label, distances in (("recorded motion", plan.distance_before), ("planned motion", plan.distance_after)):
        numbers = [sum(distances) / len(distances), *((min(distances), max(distances)) if several else ())]
        table.add_row(label, *(f"{1e3 * number:.2f}" for number in numbers))
    console.print(table)
    for name, change in plan.path_change.items():
        console.print(f"{name}: its path changes by up to {1e3 * change:.0f} mm", markup=False)
    fraction, what = plan.nearest_limit
    console.print(f"nearest limit: {what}, {100 * fraction:.0f} % of the way there", markup=False)
    if plan.nearest_solids:
        console.print(f"nearest solids: {plan.nearest_solids}", markup=False)
    console.print(
        f"{len(plan.distance_history)} motions evaluated, {plan.seconds:.0f} s; stopped: {plan.stop_reason}",
        markup=False,
    )
    for warning in plan.warnings:
        console.print(f"note: {warning}", style="yellow", markup=False)
