"""How near motions came, one after the other."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from torchcloth.identification.pictures import save_figure

COLOURS = {"gauss-newton": "#1f6f8b", "adam": "#b0653a", "sac": "#888888"}
LABELS = {"gauss-newton": "Gauss-Newton", "adam": "Adam", "sac": "Soft Actor-Critic"}


def curves(found: dict[str, Any], path: Path) -> Path:
    """The best distance so far over the motions that were simulated, one panel for each garment."""
    from matplotlib.figure import Figure

    garments = list(dict.fromkeys(name.partition("-")[0] for name in found))
    figure = Figure(figsize=(4.2 * len(garments), 3.4), layout="constrained")
    axes = figure.subplots(1, len(garments), squeeze=False)[0]
    for axis, garment in zip(axes, garments, strict=True):
        for method, colour in COLOURS.items():
            case = found.get(f"{garment}-{method}")
            if case is None:
                continue
            tried = 1e3 * np.asarray(case["history"], dtype=float)
            best = np.fmin.accumulate(tried)
            axis.plot(np.arange(1, len(best) + 1), best, color=colour, label=LABELS[method])
            if method == "sac":
                axis.plot(np.arange(1, len(tried) + 1), tried, ".", ms=2, color=colour, alpha=0.4)
        axis.set(title=garment, xscale="log", yscale="log", xlabel="motions simulated")
        axis.set_ylabel("distance from the goal [mm]")
        axis.grid(alpha=0.3, which="both")
        axis.legend(fontsize=8)
    return save_figure(figure, path)
