"""Figure of the trajectories study: distance over the simulated motions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from torchcloth._utils.files import save_figure

METHOD_COLOURS = {"gauss-newton": "#1f6f8b", "adam": "#b0653a", "sac": "#888888"}
METHOD_LABELS = {"gauss-newton": "Gauss-Newton", "adam": "Adam", "sac": "Soft Actor-Critic"}


def draw_curves(results: dict[str, Any], path: Path) -> Path:
    """Draw the best distance so far over the number of simulated motions, one panel for each garment."""
    from matplotlib.figure import Figure

    garments = list(dict.fromkeys(name.partition("-")[0] for name in results))
    figure = Figure(figsize=(4.2 * len(garments), 3.4), layout="constrained")
    axes = figure.subplots(1, len(garments), squeeze=False)[0]
    for axis, garment in zip(axes, garments, strict=True):
        for method, colour in METHOD_COLOURS.items():
            case = results.get(f"{garment}-{method}")
            if case is None:
                continue
            tried = 1e3 * np.asarray(case["history"], dtype=float)
            best = np.fmin.accumulate(tried)
            axis.plot(np.arange(1, len(best) + 1), best, color=colour, label=METHOD_LABELS[method])
            if method == "sac":
                axis.plot(np.arange(1, len(tried) + 1), tried, ".", ms=2, color=colour, alpha=0.4)
        axis.set(title=garment, xscale="log", yscale="log", xlabel="motions simulated")
        axis.set_ylabel("distance from the goal [mm]")
        axis.grid(alpha=0.3, which="both")
        axis.legend(fontsize=8)
    return save_figure(figure, path)
