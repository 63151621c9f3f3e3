"""Grid layout of figures with one panel for each episode."""

from __future__ import annotations

from typing import Any

MAX_FIGURE_COLUMNS = 3  # panels beside each other that can be read
FULL_ROW = 4  # this many panels fill one row, rather than leave one alone in a second row


def grid_shape(count: int) -> tuple[int, int]:
    """Return (columns, rows) of a grid for so many panels."""
    columns = count if count == FULL_ROW else min(count, MAX_FIGURE_COLUMNS)
    return columns, -(-count // columns)


def hide_unused_axes(axes: Any, count: int, rows_per_panel: int) -> None:
    """Hide the axes of a grid that hold no panel.

    Args:
        axes: [rows, columns] matplotlib axes.
        count: number of panels.
        rows_per_panel: rows of the grid that one row of panels takes.
    """
    columns = axes.shape[1]
    for k in range(count, axes.size // rows_per_panel):
        for row in range(rows_per_panel):
            axes[k // columns * rows_per_panel + row, k % columns].set_axis_off()
