"""Figures of the ablation: distances and energy contributions with the paper's, and the shapes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchcloth._utils.files import write_atomically

from .paper_tables import CHAMFER, ENERGY
from .runs import AblationStudy, SceneName
from .scenes import LEVELS, PARAMETERS, PERTURBED, REFERENCE, Scene, Variant

COLOURS = {"E": "#1f6f8b", "nu": "#b0653a", "k": "#3d7f3d", "gamma": "#7d4f9e"}
GREEK = {"E": "E", "nu": "ν", "k": "k", "gamma": "γ"}


def draw(
    study: AblationStudy,
    scenes: Sequence[SceneName],
    distance: dict[str, dict[Variant, float]],
    energy: dict[str, dict[str, float]],
) -> list[Path]:
    """Write ablation.png and shapes.png into the study's folder.

    Returns:
        Their paths.
    """
    figures = {"ablation.png": _comparison(distance, energy), "shapes.png": _shapes(study, scenes)}
    for name, figure in figures.items():
        with write_atomically(study.folder / name) as part:
            figure.savefig(part, dpi=110, bbox_inches="tight")
    return [study.folder / name for name in figures]


def _comparison(distance: dict[str, dict[Variant, float]], energy: dict[str, dict[str, float]]) -> Any:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.6 * len(distance), 7.5), layout="constrained")
    axes = figure.subplots(2, len(distance), squeeze=False, sharey="row")
    for column, action in enumerate(distance):
        _curves(axes[0, column], action, distance[action])
        _bars(axes[1, column], action, energy[action])
    axes[0, 0].set_ylabel("bidirectional Chamfer distance [cm]\n(paper: unit not stated)")
    axes[1, 0].set_ylabel("fraction of the elastic energy [%]")
    axes[0, 0].legend(fontsize=8, loc="upper center", ncols=2)
    axes[1, 0].legend(["ours", "paper"], fontsize=8)
    return figure


def _curves(axis: Any, action: str, row: dict[Variant, float]) -> None:
    for p in PARAMETERS:
        points = sorted((v.level, d) for v, d in row.items() if v.parameter == p)
        axis.plot(LEVELS, np.maximum(CHAMFER[action][p], 5e-3), "--", color=COLOURS[p], linewidth=1)
        if points:
            axis.plot(*zip(*points, strict=True), "o-", color=COLOURS[p], label=f"{GREEK[p]} (dashed: paper)")
    if PERTURBED in row:
        axis.axhspan(1e-6, max(row[PERTURBED], 1e-6), color="#dddddd", zorder=0, label="start moved by 1 µm")
    axis.set(title=action, xlabel="level [%]", yscale="log", ylim=(1e-3, 60), xticks=LEVELS)


def _bars(axis: Any, action: str, row: dict[str, float]) -> None:
    positions = np.arange(len(PARAMETERS))
    for shift, values, colour in (
        (-0.2, [100 * row[p] for p in PARAMETERS], "#1f6f8b"),
        (0.2, list(ENERGY[action].values()), "#bbbbbb"),
    ):
        bars = axis.bar(positions + shift, values, 0.38, color=colour)
        axis.bar_label(bars, [f"{v:z.1f}" for v in values], fontsize=8)
    axis.set(title=action, ylim=(0, 115), xticks=positions, xticklabels=[GREEK[p] for p in PARAMETERS])


def _shapes(study: AblationStudy, scenes: Sequence[SceneName]) -> Any:
    """Draw four frames of each reference run, from start to end."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 3.0 * len(scenes)))
    axes = figure.subplots(len(scenes), 4, squeeze=False, subplot_kw={"projection": "3d"})
    figure.subplots_adjust(wspace=0, hspace=0.05, left=0, right=1, top=0.98, bottom=0)
    for row, scene in enumerate(scenes):
        faces, run = Scene(study.setup, *scene).mesh.faces, study.load_run(scene, REFERENCE)
        centre, half = (run.x.max((0, 1)) + run.x.min((0, 1))) / 2, np.ptp(run.x, axis=(0, 1)).max() / 2
        for axis, i in zip(axes[row], np.linspace(0, len(run.t) - 1, 4).round().astype(int), strict=True):
            axis.plot_trisurf(*run.x[i].T, triangles=faces, color="#cfdde4", edgecolor="#6f8793", linewidth=0.2)
            axis.set(xlim=centre[0] + [-half, half], ylim=centre[1] + [-half, half], zlim=centre[2] + [-half, half])
            axis.set_title(f"{' '.join(scene)}, {run.t[i]:.2f} s from the first frame", fontsize=9, y=0.95)
            axis.set_box_aspect((1, 1, 1))
            axis.tick_params(labelsize=6)
            axis.locator_params(nbins=4)
            axis.view_init(elev=22, azim=-60)
    return figure
