"""Tables for a terminal, results as JSON."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchcloth._utils.files import to_json, write_text

if TYPE_CHECKING:
    from rich.table import Table

WIDTH = 132


def heading_table(title: str, *headings: str) -> Table:
    """A table whose first two columns are words."""
    from rich import box
    from rich.table import Table

    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD)
    for i, heading in enumerate(headings):
        table.add_column(heading, justify="left" if i < 2 else "right", no_wrap=True)
    return table


def show(*parts: Any) -> None:
    """Print tables and notes, 132 columns wide or more."""
    from rich.console import Console

    console = Console(highlight=False, markup=False)
    console.width = max(console.width, WIDTH)
    for part in parts:
        console.print(part)


def write(path: Path, result: dict[str, Any]) -> None:
    """Write a result; what is not a number is null."""
    write_text(path, to_json(result))


def number(value: float | None, digits: int = 4) -> str:
    """With so many digits."""
    return "–" if value is None or math.isnan(value) else f"{value:.{digits}g}"


def percent(share: float | None) -> str:
    """One digit behind the point."""
    return "–" if share is None or math.isnan(share) else f"{100 * share:.1f} %"


def mm(length: float | None) -> str:
    """Millimetres with two digits behind the point."""
    return "–" if length is None or math.isnan(length) else f"{1e3 * length:.2f}"
