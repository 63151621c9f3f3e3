"""Print predictions as tables for a terminal, and draw them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from .._utils.constants import Z_95
from .episode_prediction import EpisodePrediction
from .pictures import AFTER_COLOUR, BEFORE_COLOUR, NULL_COLOUR
from .tables import MIN_FIT_TABLE_COLUMNS
from .tension.prediction import PredictionBand, TensionPrediction

MAX_PRINTED_ROWS = 9  # of a curve
MIN_RELATIVE_PART = 1e-6  # of the largest force, below which a part of the error is printed as 0


def print_tension_prediction(prediction: TensionPrediction) -> None:
    """Print a curve with its interval and the parts of its error."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    console = Console(highlight=False)
    console.width = max(console.width, MIN_FIT_TABLE_COLUMNS)
    t, lateral = prediction.table, prediction.lateral_strain
    size = f"{1e3 * t.length:g} mm x {1e3 * t.width:g} mm, preload {t.preload:.3g} N"
    title = f"Strip at {math.degrees(t.angle):g} degrees to the warp, {size}"
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD)
    columns = ["mm", "strain", "force N", "by parameters", "by the misfit", "by the setup", "95 % interval"]
    for heading in columns + (["lateral strain", "95 % interval"] if lateral else []):
        table.add_column(heading, justify="right")
    order = np.argsort(t.displacement, kind="stable")
    min_printed_n = MIN_RELATIVE_PART * np.abs(prediction.force.value).max()
    for i in order[np.linspace(0, len(t) - 1, min(MAX_PRINTED_ROWS, len(t))).round().astype(int)]:
        f = prediction.force
        parts = [
            f"± {part[i] if part[i] > min_printed_n else 0:.2g}"
            for part in (f.parameter_std, f.misfit_std, f.setup_std)
        ]
        cells = [f"{1e3 * t.displacement[i]:.3g}", f"{t.strain[i]:.4f}", f"{f.value[i]:.4g}", *parts, _interval(f, i)]
        if lateral:
            cells += [f"{lateral.value[i]:.4f}", _interval(lateral, i)]
        table.add_row(*cells)
    console.print(table)
    console.print(f"by the misfit of the law to a curve, from {prediction.misfit_source}", markup=False)
    for kind, e in prediction.compare_with_readings().items():
        numbers = f"rms {100 * e['rms']:.1f} %, largest {100 * e['max']:.1f} % of the largest reading"
        console.print(f"measured {kind}: {numbers}; {100 * e['coverage']:.0f} % of the readings inside", markup=False)
    for warning in prediction.warnings:
        console.print(f"note: {warning}", style="yellow", markup=False)


def _interval(band: PredictionBand, i: int) -> str:
    low, high = (end[i] for end in band.ci95)
    return f"{low:.3g} … {high:.3g}"


def plot_tension_prediction(prediction: TensionPrediction) -> Any:
    """Draw the curve with the interval by parameters inside the whole one, and readings where there are any."""
    from matplotlib.figure import Figure

    t = prediction.table
    kinds: list[tuple[str, PredictionBand, np.ndarray | None]] = [("force [N]", prediction.force, t.force)]
    if prediction.lateral_strain is not None:
        kinds.append(("lateral strain", prediction.lateral_strain, t.lateral_strain))
    figure = Figure(figsize=(6.5 * len(kinds), 4.5), layout="constrained")
    order = np.argsort(t.strain, kind="stable")
    for axis, (label, band, seen) in zip(figure.subplots(1, len(kinds), squeeze=False)[0], kinds, strict=True):
        draw_band(axis, 100 * t.strain[order], band, order)
        if seen is not None and np.isfinite(seen).any():
            axis.plot(100 * t.strain, seen, ".", color="black", markersize=3, label="measured")
        axis.set(xlabel="strain [%]", ylabel=label)
    figure.axes[0].legend()
    figure.suptitle(f"strip at {math.degrees(t.angle):g} degrees to the warp, 95 % intervals", fontsize=11)
    return figure


def draw_band(axis: Any, x: np.ndarray, band: PredictionBand, order: np.ndarray | slice = slice(None)) -> None:
    """Draw a curve and its intervals."""
    low, high = band.ci95
    axis.fill_between(x, low[order], high[order], color=AFTER_COLOUR, alpha=0.18, linewidth=0, label="all parts")
    inner = Z_95 * band.parameter_std
    ends = ((band.value - inner)[order], (band.value + inner)[order])
    axis.fill_between(x, *ends, color=AFTER_COLOUR, alpha=0.45, linewidth=0, label="by parameters")
    axis.plot(x, band.value[order], color=AFTER_COLOUR, label="predicted")


def print_episode_prediction(prediction: EpisodePrediction) -> None:
    """Print how sure the prediction is, and how far it is from the data."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    console, f, content = Console(highlight=False), prediction.metrics, prediction.as_dict()
    std = content["std_parameters"]
    print(f"{prediction.episode.name}: {content['frames']} frames, {len(prediction.cloth.mesh.faces)} triangles")
    print(f"by parameters: a vertex is known to {1e3 * std['rms']:.2g} mm (rms; at most {1e3 * std['max']:.2g} mm)")
    if math.isfinite(prediction.misfit_std):
        print(
            f"by the misfit: the fit left {1e3 * prediction.misfit_std:.2g} mm rms in its own episodes, noise included"
        )
    if math.isfinite(prediction.misfit_std):
        half = content["interval"]
        inside = "" if half["coverage"] is None else f"; {100 * half['coverage']:.0f} % of them are"
        print(
            f"together:      95 % of measured points should be within {1e3 * half['rms']:.2g} mm of the surface{inside}"
        )
    for warning in prediction.warnings:
        print(f"warning: {warning}")
    columns = {"rms mm": ("rms", 1e3), "Chamfer mm": ("chamfer", 1e3), "force rms N": ("force_rms", 1.0)}
    known = {heading: (key, unit) for heading, (key, unit) in columns.items() if math.isfinite(f.get(key, math.nan))}
    if not known:
        print("the episode has no data to compare with")
        return
    table = Table(title="Against what was measured", title_justify="left", box=box.SIMPLE_HEAD)
    for heading in ("", *known):
        table.add_column(heading, justify="right" if heading else "left")
    for label, end in (("null: carried rigidly, no force", "_null"), ("predicted", "")):
        table.add_row(label, *(f"{unit * f[name + end]:.3g}" for name, unit in known.values()))
    console.print(table)
    if "rms mm" not in known:
        print("the episode has no points and no markers: only its forces are compared with")


def plot_episode_prediction(prediction: EpisodePrediction) -> Any:
    """Draw over time the mean distance of the points, and the standard error by the parameters."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.5, 4), layout="constrained")
    axis, e = figure.subplots(), prediction.episode
    shown = [t for t in range(len(e.times)) if len(e.observed_points(t))]
    std = 1e3 * prediction.vertex_std.square().mean(-1).sqrt()
    axis.plot(e.times, std, color=AFTER_COLOUR, label="standard error by the parameters")
    if shown:
        axis.plot(
            e.times[shown],
            1e3 * prediction.per_frame,
            color=BEFORE_COLOUR,
            label="points: mean distance from the prediction",
        )
    if math.isfinite(prediction.misfit_std):
        axis.axhline(
            1e3 * prediction.misfit_std,
            color=NULL_COLOUR,
            linestyle="--",
            label="rms that the fit left in its own episodes",
        )
        half = 1e3 * prediction.half_width.square().mean(-1).sqrt()
        axis.plot(
            e.times, half, color=AFTER_COLOUR, linestyle=":", label="both: 95 % of measured points should be nearer"
        )
    axis.set(xlabel="time [s]", ylabel="mm")
    axis.set_title(f"{e.name}, predicted", parse_math=False)
    axis.set_ylim(bottom=0)
    axis.legend()
    return figure
