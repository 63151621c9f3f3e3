"""Figures of the study of measured cloth: measured dots, predicted lines with intervals."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from torchcloth._utils.constants import Z_95
from torchcloth._utils.files import save_figure
from torchcloth.identification.pictures import AFTER_COLOUR, BEFORE_COLOUR, NULL_COLOUR
from torchcloth.identification.prediction_report import draw_band
from torchcloth.identification.tension.prediction import PredictionBand

from ...validation.realdata import knits as knit_adapter
from ...validation.realdata import nylon as nylon_adapter
from .measured_tables import MODEL_LABELS
from .tension import MAX_ROBOT_FORCE_N

MODEL_COLOURS = {"vacuum": NULL_COLOUR, "textbook": "#c9a227", "whole": AFTER_COLOUR, "free": BEFORE_COLOUR}


def load_band(prediction: dict[str, Any]) -> PredictionBand:
    """Load a prediction band from a case's JSON."""
    keys = ("value", "std_parameters", "std_misfit", "std_setup")
    return PredictionBand(*(np.array(prediction[key]) for key in keys))


def nylon(result: dict[str, Any], source: Path, path: Path) -> Path:
    """Draw each angle as predicted from the other three."""
    figure, axes = make_figure(1, len(result["left_out"]), (15, 4))
    tables = nylon_adapter.read_tables(source)
    for axis, (angle, prediction) in zip(axes[0], result["left_out"].items(), strict=True):
        table = tables[int(angle)]
        axis.plot(100 * table.strain, table.force, ".", color="black", markersize=3, label="measured")
        draw_band(axis, 100 * np.array(prediction["strain"]), load_band(prediction["force"]))
        notes = ["outside of the fitted angles"] if any("outside" in w for w in prediction["warnings"]) else []
        notes = [f"{name} not identifiable" for name in prediction["not_identifiable"]] or notes
        axis.set_title("\n".join([f"{angle}° from the other three", *notes]), fontsize=10)
        axis.set_xlabel("strain [%]")
        axis.set_ylim(0, 1.4 * table.force.max())
    axes[0, 0].set_ylabel("force [N]")
    axes[0, 0].legend(fontsize=8)
    figure.suptitle("nylon, 95 % intervals")
    return save_figure(figure, path)


def knits(result: dict[str, Any], source: Path, path: Path) -> Path:
    """Draw force and lateral strain of the third pull."""
    figure, axes = make_figure(2, len(result), (3.4 * len(result) + 0.6, 6.5))
    fabrics = knit_adapter.read_fabrics(source)
    for column, (name, fabric) in zip(axes.T, result.items(), strict=True):
        for colour, (one, whole) in zip(
            (AFTER_COLOUR, BEFORE_COLOUR), zip(fabric["directions"].items(), fabrics[name], strict=True), strict=True
        ):
            label, prediction = one[0], one[1]["prediction"]
            seen = whole.select_rows(whole.force < MAX_ROBOT_FORCE_N).select_repeats(3)
            for axis, kind, readings in zip(
                column, ("force", "lateral_strain"), (seen.force, seen.lateral_strain), strict=True
            ):
                axis.plot(100 * seen.strain, readings, ".", color=colour, markersize=4)
                prediction_band, x = load_band(prediction[kind]), 100 * np.array(prediction["strain"])
                axis.fill_between(x, *prediction_band.ci95, color=colour, alpha=0.15, linewidth=0)
                axis.plot(x, prediction_band.value, color=colour, label=f"along {label}")
        column[0].set_title(name.replace("_", " "), fontsize=9)
        column[1].set_xlabel("strain [%]")
    axes[0, 0].set_ylabel("force [N]")
    axes[1, 0].set_ylabel("lateral strain")
    axes[0, 0].legend(fontsize=8)
    figure.suptitle("knits: third pull (dots), predicted from the first two (lines, 95 % intervals)")
    return save_figure(figure, path)


def swings(result: dict[str, Any], runs: dict[str, dict[str, Any]], path: Path) -> Path:
    """Draw the lower edge of one predicted run, and frequency and decay of all models."""
    figure, axes = make_figure(1, 3, (15, 4.2))
    name, run = next(reversed(runs.items()))
    t, seen = np.array(run["t"]), np.array([np.nan if y is None else y for y in run["lower_edge"]])
    for model in ("vacuum", "whole", "free"):
        axes[0, 0].plot(
            t[: len(run[model]["lower_edge"])],
            run[model]["lower_edge"],
            color=MODEL_COLOURS[model],
            lw=1,
            label=MODEL_LABELS[model],
        )
    axes[0, 0].plot(t, seen, ".", color="black", markersize=4, label="measured")
    axes[0, 0].set(
        title=f"{name}, predicted: lower edge", xlabel="seconds from the first frame", ylabel="y along the stroke [m]"
    )
    axes[0, 0].legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=4, columnspacing=1)
    for axis, key, label in zip(axes[0, 1:], ("frequency", "decay"), ("swing [Hz]", "decay B [1/(m s)]"), strict=True):
        shown = {m: p for m, p in result["predicted"].items() if key in p}
        for k, (model, p) in enumerate(shown.items()):
            colour = MODEL_COLOURS.get(model, "black")
            axis.errorbar(p[key], -k, xerr=Z_95 * p[f"{key}_std"], fmt="o", color=colour, capsize=3)
        axis.set_yticks(
            [-k for k in range(len(shown))], [MODEL_LABELS[m].replace(": ", ":\n") for m in shown], fontsize=8
        )
        axis.axvline(shown["measured"][key], color="black", lw=0.5)
        axis.set(xlabel=label, title=f"free swings of {len(runs)} predicted runs")
    return save_figure(figure, path)


def make_figure(rows: int, columns: int, size: tuple[float, float]) -> tuple[Any, np.ndarray]:
    """Make a figure with a grid of axes."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False)
