"""Figure of the trajectories study: distance over simulated motions and over CPU time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from torchcloth._utils.files import save_figure

METHOD_COLOURS = {"gauss-newton": "#1f6f8b", "adam": "#b0653a", "cma-es": "#5b8c3e", "sac": "#888888"}
METHOD_LABELS = {"gauss-newton": "Gauss-Newton", "adam": "Adam", "cma-es": "CMA-ES", "sac": "Soft Actor-Critic"}
CURVE_POINTS = 300


def draw_curves(results: dict[str, Any], path: Path) -> Path:
    """Draw the best distance so far: median over the seeds as a line, their range as an area.

    One column for each garment; over simulated motions above, over CPU time below.
    """
    from matplotlib.figure import Figure

    garments = list(dict.fromkeys(case["garment"] for case in results.values()))
    figure = Figure(figsize=(4.2 * len(garments), 6.2), layout="constrained")
    axes = figure.subplots(2, len(garments), squeeze=False)
    for row, label in enumerate(("simulated motions", "CPU time [s]")):
        for axis, garment in zip(axes[row], garments, strict=True):
            for method, colour in METHOD_COLOURS.items():
                cases = [c for c in results.values() if c["garment"] == garment and c["method"] == method]
                if cases:
                    places, curves = _best_so_far([c["history"] for c in cases], row)
                    axis.plot(places, np.median(curves, axis=0), color=colour, label=METHOD_LABELS[method])
                    axis.fill_between(places, curves.min(0), curves.max(0), color=colour, alpha=0.18, lw=0)
            axis.set(title=garment if row == 0 else "", xscale="log", yscale="log", xlabel=label)
            axis.set_ylabel("distance from the goal [mm]")
            axis.grid(alpha=0.3, which="both")
    axes[0, 0].legend(fontsize=8)
    return save_figure(figure, path)


def _best_so_far(histories: list[Any], column: int) -> tuple[np.ndarray, np.ndarray]:
    """Return places [P] along motions (0) or seconds (1), and best distances [seeds, P] mm.

    A curve goes on at its last value where another seed's is longer.
    """
    tables = [np.array([[np.nan if x is None else x for x in trial] for trial in h], dtype=float) for h in histories]
    begin = max(float(t[0, column]) for t in tables)
    places = np.geomspace(max(begin, 1e-3), max(float(t[-1, column]) for t in tables) + 1e-3, CURVE_POINTS)
    curves = []
    for table in tables:
        best = 1e3 * np.fmin.accumulate(table[:, 2])
        index = np.searchsorted(table[:, column], places, side="right") - 1
        curves.append(best[index.clip(0)])
    return places, np.stack(curves)
