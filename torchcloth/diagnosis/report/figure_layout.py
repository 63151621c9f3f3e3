"""Pictures of several episodes, as a page shows them: not more beside each other than can be read."""

from __future__ import annotations

from typing import Any

ACROSS = 3


def grid_shape(count: int) -> tuple[int, int]:
    """(columns, lines) of so many."""
    return min(count, ACROSS), -(-count // ACROSS)


def hide_unused_axes(axes: Any, count: int, rows: int) -> None:
    """Clear the places of a grid that hold nothing; ``rows`` of it belong to one line of the ``count`` pictures."""
    across = axes.shape[1]
    for k in range(count, axes.size // rows):
        for row in range(rows):
            axes[k // across * rows + row, k % across].set_axis_off()
