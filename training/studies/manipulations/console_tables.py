"""Tables for a terminal."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.table import Table

MIN_TABLE_WIDTH = 132


def heading_table(title: str, *headings: str) -> Table:
    """Return a table whose first two columns are left-aligned."""
    from rich import box
    from rich.table import Table

    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD)
    for i, heading in enumerate(headings):
        table.add_column(heading, justify="left" if i < 2 else "right", no_wrap=True)
    return table


def show(*parts: Any) -> None:
    """Print tables and notes, at least 132 columns wide."""
    from rich.console import Console

    console = Console(highlight=False, markup=False)
    console.width = max(console.width, MIN_TABLE_WIDTH)
    for part in parts:
        console.print(part)


def number(value: float | None, digits: int = 4) -> str:
    """Format a number with significant digits; a dash if there is none."""
    return "–" if value is None or math.isnan(value) else f"{value:.{digits}g}"


def percent(share: float | None) -> str:
    """Format a fraction as a percentage with one decimal."""
    return "–" if share is None or math.isnan(share) else f"{100 * share:.1f} %"


def mm(length: float | None) -> str:
    """Format a length in millimetres with two decimals."""
    return "–" if length is None or math.isnan(length) else f"{1e3 * length:.2f}"
