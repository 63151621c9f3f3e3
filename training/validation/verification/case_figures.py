"""Pictures of the cases. The same data give the same bytes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from .registry import Case, Outcome

TRUTH_COLOUR, MEASURED_COLOUR, SECOND_COLOUR = "#888888", "#1f6f8b", "#b0653a"
COLOUR_CYCLE = (MEASURED_COLOUR, SECOND_COLOUR, "#4c9a5b", "#8566a8", "#c2a23a", "#c95f8a", "#555555")


def line_colour(k: int) -> str:
    """Return the colour of the k-th line."""
    return COLOUR_CYCLE[k % len(COLOUR_CYCLE)]


def draw_case(case: Case, outcome: Outcome, folder: Path) -> bool:
    """Write ``folder``/verification/NAME.png; return False where the case has no picture."""
    if case.draw is None or not outcome.data:
        return False
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    file = folder / "verification" / f"{case.name}.png"
    file.parent.mkdir(parents=True, exist_ok=True)
    with rc_context({"font.size": 8, "axes.spines.top": False, "axes.spines.right": False, "legend.frameon": False}):
        figure = Figure(figsize=(5.6, 3.2), layout="constrained")
        case.draw(figure, outcome.data)
        figure.savefig(file, dpi=110, metadata={"Software": None})
    return True


def plot_against_truth(
    axis: Any, x: np.ndarray, measured: np.ndarray, truth: np.ndarray, labels: tuple[str, str]
) -> None:
    """Plot the truth as a line, and measured values as dots over it."""
    axis.plot(x, truth, color=TRUTH_COLOUR, lw=2.5, label="truth")
    axis.plot(x, measured, ".", color=MEASURED_COLOUR, ms=5, label="measured")
    axis.set(xlabel=labels[0], ylabel=labels[1])
    axis.legend()


def plot_mesh(axis: Any, x: np.ndarray, faces: np.ndarray, title: str) -> None:
    """Plot a mesh in a three-dimensional axis with equal scales."""
    axis.plot_trisurf(*x.T, triangles=faces, color=MEASURED_COLOUR, edgecolor="#ffffff", linewidth=0.15, alpha=0.85)
    middle, half = (x.max(0) + x.min(0)) / 2, max(np.ptp(x, axis=0).max() / 2, 1e-3)
    axis.set(xlim=middle[0] + [-half, half], ylim=middle[1] + [-half, half], zlim=middle[2] + [-half, half])
    axis.set_title(title, fontsize=8)
    axis.set_axis_off()
