"""Table and figure of the distances between the two engines."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np

from torchcloth._utils.files import write_text

LINE_COLOURS = ("#c9a58f", "#b0653a", "#1f6f8b")
MAX_COLUMNS = 6  # motions side by side
FRAME_PERIOD_S = 0.02  # of the truth


def format_table(results: dict[str, Any], motions: Sequence[str], meshes: Sequence[int]) -> str:
    """Return a Markdown table with a row for each motion and distances in mm."""
    columns = [label for label, _ in _series(meshes)] + [f"truth on {n} × {n}" for n in meshes]
    rows = ["| motion | fastest point, m/s | " + " | ".join(columns) + " |", "|---|---" + "|---" * len(columns) + "|"]
    for name in motions:
        cells = [_cell(results[key.format(name)]) for _, key in _series(meshes)]
        others = [results.get(f"truth {name} {n}") for n in meshes]
        cells += ["" if other is None else f"{1e3 * other:.2f}" for other in others]
        rows.append(f"| {name} | {results[f'episode {name}']:.2f} | " + " | ".join(cells) + " |")
    return "\n".join(rows)


def _series(meshes: Sequence[int]) -> list[tuple[str, str]]:
    """Return labels and keys of the simulations of a motion."""
    fitted = (f"{meshes[0]} × {meshes[0]}, fitted values", f"fitted {{}} {meshes[0]}")
    true = [(f"{n} × {n}, true values", f"true {{}} {n}") for n in meshes]
    return [true[0], fitted, *true[1:]]


def format_parameters(results: dict[str, Any]) -> str:
    """Return a Markdown table of the fitted and the true parameters."""
    units = {"membrane_stiffness": "N/m", "poisson_ratio": "-", "bending_stiffness": "N m", "damping_time": "s"}
    fit = results["fit"]
    rows = ["| parameter | truth | fitted |", "|---|---|---|"]
    rows += [f"| {key} [{unit}] | {fit['true'][key]:.3g} | {fit['values'][key]:.3g} |" for key, unit in units.items()]
    return "\n".join(rows)


def _cell(distance: dict[str, Any]) -> str:
    return f"{1e3 * distance['material_rms']:.2f} ({1e3 * distance['surface_rms']:.2f})"


def write_page(results: dict[str, Any], motions: Sequence[str], meshes: Sequence[int], folder: Path) -> Path:
    """Write ``folder``/null.md and return its path."""
    text = f"{format_table(results, motions, meshes)}\n\n{format_parameters(results)}\n"
    return write_text(folder / "null.md", text)


def draw_figure(results: dict[str, Any], motions: Sequence[str], meshes: Sequence[int], folder: Path) -> Path:
    """Draw ``folder``/null.png and return its path: distances over time, and over the fabric."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    style = {"font.size": 8, "axes.spines.top": False, "axes.spines.right": False, "legend.frameon": False}
    with rc_context(cast(Any, style)):
        columns = min(MAX_COLUMNS, len(motions))
        rows = -(-len(motions) // columns)
        figure = Figure(figsize=(1.7 * columns, 3.0 * rows + 0.3), layout="constrained")
        axes = figure.subplots(2 * rows, columns, squeeze=False)
        for axis in axes.ravel():
            axis.set_visible(False)
        for k, name in enumerate(motions):
            above, below = axes[2 * (k // columns) : 2 * (k // columns) + 2, k % columns]
            _draw_over_time(above, results, name, meshes)
            image = _draw_over_fabric(below, results[_series(meshes)[-1][1].format(name)]["rms_by_vertex"])
            figure.colorbar(image, ax=below, shrink=0.8, aspect=12)
        figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=3)
        figure.supylabel(f"RMS, mm: over time; and over the fabric ({_series(meshes)[-1][0]})", fontsize=8)
        file = folder / "null.png"
        figure.savefig(file, dpi=100, metadata={"Software": None})
    return file


def _draw_over_time(axis: Any, results: dict[str, Any], name: str, meshes: Sequence[int]) -> None:
    for (label, key), colour in zip(_series(meshes), LINE_COLOURS, strict=False):
        values = 1e3 * np.asarray(results[key.format(name)]["rms_by_frame"])
        axis.plot(FRAME_PERIOD_S * np.arange(len(values)), values, color=colour, label=label, lw=1)
    axis.set_visible(True)
    axis.set_title(name)
    axis.set_ylim(bottom=0)
    axis.set_xlabel("t, s")


def _draw_over_fabric(axis: Any, rms_by_vertex: list[float]) -> Any:
    axis.set_visible(True)
    n = round(len(rms_by_vertex) ** 0.5)
    image = axis.imshow(1e3 * np.asarray(rms_by_vertex).reshape(n, n), origin="lower", cmap="viridis", vmin=0)
    axis.set_xticks([])
    axis.set_yticks([])
    return image
