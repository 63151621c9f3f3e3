"""Figures of the classification: the identified parameters and the confusion matrices."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchcloth._utils.files import write_atomically

from .paper_fabrics import FABRICS

FABRIC_COLOURS = ("#1f6f8b", "#b0653a", "#3d7f3d", "#7d4f9e", "#c0392b")


def draw(folder: Path, trials: Sequence[Any], results: Mapping[str, Mapping[str, Any]]) -> Path:
    """Write classify.png and return its path."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.0 * (1 + len(results)), 4.8), layout="constrained")
    axes = figure.subplots(1, 1 + len(results))
    _places(axes[0], trials, list(next(iter(results.values()))["matrix"]))
    for axis, (title, result) in zip(axes[1:], results.items(), strict=True):
        _matrix(axis, title, result)
    with write_atomically(folder / "classify.png") as part:
        figure.savefig(part, dpi=110, bbox_inches="tight")
    return folder / "classify.png"


def _places(axis: Any, trials: Sequence[Any], fabrics: Sequence[str]) -> None:
    for colour, name in zip(FABRIC_COLOURS, fabrics, strict=False):
        group = [t for t in trials if t.fabric == name]
        if group:
            stiffness = np.exp([t.place[0] for t in group]) / 1e3
            poisson = 0.5 / (1 + np.exp([-t.place[1] for t in group]))
            bars = [t.error[1] for t in group] * poisson * (0.5 - poisson) / 0.5
            axis.errorbar(stiffness, poisson, bars, fmt="o", ms=3, color=colour, label=FABRICS[name])
    axis.set(xscale="log", xlabel="E [kPa]", ylabel="ν", ylim=(0, 0.5), title="identified, with standard errors of ν")
    axis.set_xticks([200, 500, 1000, 2000, 4000], ["200", "500", "1000", "2000", "4000"])
    axis.minorticks_off()
    axis.legend(fontsize=8)


def _matrix(axis: Any, title: str, result: Mapping[str, Any]) -> None:
    names = list(result["matrix"])
    counts = np.array([list(row.values()) for row in result["matrix"].values()])
    axis.imshow(counts / counts.sum(1, keepdims=True).clip(min=1), cmap="Blues", vmin=0, vmax=1.4)
    for (i, j), count in np.ndenumerate(counts):
        axis.text(j, i, f"{count}" if count else "·", ha="center", va="center")
    short = [FABRICS[name].partition(" (")[0] for name in names]
    axis.set(
        xlabel="assigned fabric", ylabel="true fabric", title=f"{title}: {result['right']} of {result['trials']} right"
    )
    axis.set_xticks(range(len(names)), short, rotation=30, ha="right")
    axis.set_yticks(range(len(names)), short)
