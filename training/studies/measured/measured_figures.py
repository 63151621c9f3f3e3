"""Pictures of the study: measured dots, predicted lines with their intervals."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from torchcloth.identification.pictures import AFTER, BEFORE, NULL, save_figure
from torchcloth.identification.prediction_report import draw_band
from torchcloth.identification.tension.prediction import PredictionBand

from ...validation.realdata import knits as knit_adapter
from ...validation.realdata import nylon as nylon_adapter
from .measured_tables import MODELS
from .tension import LIGHT

TINTS = {"vacuum": NULL, "textbook": "#c9a227", "whole": AFTER, "free": BEFORE}


def band(study: dict[str, Any]) -> PredictionBand:
    """From the case's JSON."""
    return PredictionBand(*(np.array(study[key]) for key in ("value", "std_parameters", "std_law", "std_setup")))


def nylon(found: dict[str, Any], source: Path, path: Path) -> Path:
    """Every angle as the other three predict it."""
    figure, axes = _figure(1, len(found["left_out"]), (15, 4))
    tables = nylon_adapter.tables(source)
    for axis, (angle, study) in zip(axes[0], found["left_out"].items(), strict=True):
        table = tables[int(angle)]
        axis.plot(100 * table.strain, table.force, ".", color="black", markersize=3, label="measured")
        draw_band(axis, 100 * np.array(study["strain"]), band(study["force"]))
        notes = ["outside of the fitted angles"] if any("outside" in w for w in study["warnings"]) else []
        notes = [f"{name} not identifiable" for name in study["not_identifiable"]] or notes
        axis.set_title("\n".join([f"{angle}° from the other three", *notes]), fontsize=10)
        axis.set_xlabel("strain [%]")
        axis.set_ylim(0, 1.4 * table.force.max())
    axes[0, 0].set_ylabel("force [N]")
    axes[0, 0].legend(fontsize=8)
    figure.suptitle("nylon, 95 % intervals")
    return save_figure(figure, path)


def knits(found: dict[str, Any], source: Path, path: Path) -> Path:
    """Force and lateral strain of the third pull."""
    figure, axes = _figure(2, len(found), (3.4 * len(found) + 0.6, 6.5))
    fabrics = knit_adapter.fabrics(source)
    for column, (name, fabric) in zip(axes.T, found.items(), strict=True):
        for tint, (one, whole) in zip(
            (AFTER, BEFORE), zip(fabric["directions"].items(), fabrics[name], strict=True), strict=True
        ):
            label, study = one[0], one[1]["prediction"]
            seen = whole.select_rows(whole.force < LIGHT).select_repeats(3)
            for axis, kind, readings in zip(
                column, ("force", "lateral_strain"), (seen.force, seen.lateral_strain), strict=True
            ):
                axis.plot(100 * seen.strain, readings, ".", color=tint, markersize=4)
                own, x = band(study[kind]), 100 * np.array(study["strain"])
                axis.fill_between(x, *own.ci95, color=tint, alpha=0.15, linewidth=0)
                axis.plot(x, own.value, color=tint, label=f"along {label}")
        column[0].set_title(name.replace("_", " "), fontsize=9)
        column[1].set_xlabel("strain [%]")
    axes[0, 0].set_ylabel("force [N]")
    axes[1, 0].set_ylabel("lateral strain")
    axes[0, 0].legend(fontsize=8)
    figure.suptitle("knits: third pull (dots), predicted from the first two (lines, 95 % intervals)")
    return save_figure(figure, path)


def swings(found: dict[str, Any], runs: dict[str, dict[str, Any]], path: Path) -> Path:
    """The lower edge of one predicted run, and frequency and decay of all models."""
    figure, axes = _figure(1, 3, (15, 4.2))
    name, run = next(reversed(runs.items()))
    t, seen = np.array(run["t"]), np.array([np.nan if y is None else y for y in run["lower_edge"]])
    for model in ("vacuum", "whole", "free"):
        axes[0, 0].plot(
            t[: len(run[model]["lower_edge"])], run[model]["lower_edge"], color=TINTS[model], lw=1, label=MODELS[model]
        )
    axes[0, 0].plot(t, seen, ".", color="black", markersize=4, label="measured")
    axes[0, 0].set(title=f"{name}, predicted: lower edge", xlabel="time [s]", ylabel="y along the stroke [m]")
    axes[0, 0].legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=4, columnspacing=1)
    for axis, key, label in zip(axes[0, 1:], ("frequency", "decay"), ("swing [Hz]", "decay B [1/(m s)]"), strict=True):
        shown = {m: p for m, p in found["predicted"].items() if key in p}
        for k, (model, p) in enumerate(shown.items()):
            tint = TINTS.get(model, "black")
            axis.errorbar(p[key], -k, xerr=1.96 * p[f"{key}_std"], fmt="o", color=tint, capsize=3)
        axis.set_yticks([-k for k in range(len(shown))], [MODELS[m].replace(": ", ":\n") for m in shown], fontsize=8)
        axis.axvline(shown["measured"][key], color="black", lw=0.5)
        axis.set(xlabel=label, title=f"free swings of {len(runs)} predicted runs")
    return save_figure(figure, path)


def _figure(rows: int, columns: int, size: tuple[float, float]) -> tuple[Any, np.ndarray]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False)
