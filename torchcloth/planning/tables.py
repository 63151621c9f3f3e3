"""A plan as a table for a terminal."""

from __future__ import annotations

from .result import MotionPlan


def print_plan(found: MotionPlan) -> None:
    """Distances, what moves, what limits it, warnings."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    console = Console(highlight=False)
    console.width = max(console.width, 100)
    table = Table(title_justify="left", box=box.SIMPLE_HEAD)
    several = len(found.after) > 1
    headings = ("mean of the models [mm]", "least", "most") if several else ("from the goal at the end [mm]",)
    for heading in ("", *headings):
        table.add_column(heading, justify="right" if heading else "left", no_wrap=True)
    for label, each in (("recorded motion", found.before), ("planned motion", found.after)):
        numbers = [sum(each) / len(each), *((min(each), max(each)) if several else ())]
        table.add_row(label, *(f"{1e3 * number:.2f}" for number in numbers))
    console.print(table)
    for name, far in found.moved.items():
        console.print(f"{name}: its path moves by up to {1e3 * far:.0f} mm", markup=False)
    share, what = found.limit
    console.print(f"nearest limit: {what}, {100 * share:.0f} % of the way there", markup=False)
    if found.nearest:
        console.print(f"nearest solids: {found.nearest}", markup=False)
    console.print(f"{len(found.history)} motions looked at, {found.seconds:.0f} s; ended: {found.ended}", markup=False)
    for warning in found.warnings:
        console.print(f"note: {warning}", style="yellow", markup=False)
