"""The null as a table and as a picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchcloth._utils.files import write_text

COLOURS = ("#c9a58f", "#b0653a", "#1f6f8b")
ACROSS = 6  # motions side by side
PERIOD = 0.02  # s, of the truth's frames


def table(found: dict[str, Any], motions: Sequence[str], meshes: Sequence[int]) -> str:
    """Markdown: a row for each motion, distances in mm."""
    columns = [label for label, _ in _series(meshes)] + [f"truth on {n} × {n}" for n in meshes]
    rows = ["| motion | fastest point, m/s | " + " | ".join(columns) + " |", "|---|---" + "|---" * len(columns) + "|"]
    for name in motions:
        cells = [_cell(found[key.format(name)]) for _, key in _series(meshes)]
        others = [found.get(f"truth {name} {n}") for n in meshes]
        cells += ["" if other is None else f"{1e3 * other:.2f}" for other in others]
        rows.append(f"| {name} | {found[f'episode {name}']:.2f} | " + " | ".join(cells) + " |")
    return "\n".join(rows)


def _series(meshes: Sequence[int]) -> list[tuple[str, str]]:
    """Labels and keys of the simulations of a motion."""
    fitted = (f"{meshes[0]} × {meshes[0]}, fitted values", f"fitted {{}} {meshes[0]}")
    true = [(f"{n} × {n}, true values", f"true {{}} {n}") for n in meshes]
    return [true[0], fitted, *true[1:]]


def parameters(found: dict[str, Any]) -> str:
    """Markdown: what the fit found beside the truth."""
    units = {"membrane_stiffness": "N/m", "poisson_ratio": "-", "bending_stiffness": "N m", "damping_time": "s"}
    fit = found["fit"]
    rows = ["| parameter | truth | fitted |", "|---|---|---|"]
    rows += [f"| {key} [{unit}] | {fit['true'][key]:.3g} | {fit['values'][key]:.3g} |" for key, unit in units.items()]
    return "\n".join(rows)


def _cell(distance: dict[str, Any]) -> str:
    return f"{1e3 * distance['material']:.2f} ({1e3 * distance['surface']:.2f})"


def write(found: dict[str, Any], motions: Sequence[str], meshes: Sequence[int], folder: Path) -> Path:
    """``folder``/null.md."""
    text = f"{table(found, motions, meshes)}\n\n{parameters(found)}\n"
    return write_text(folder / "null.md", text)


def draw(found: dict[str, Any], motions: Sequence[str], meshes: Sequence[int], folder: Path) -> Path:
    """``folder``/null.png: how the distance grows with time, and where in the fabric it is."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    style = {"font.size": 8, "axes.spines.top": False, "axes.spines.right": False, "legend.frameon": False}
    with rc_context(style):
        columns = min(ACROSS, len(motions))
        rows = -(-len(motions) // columns)
        figure = Figure(figsize=(1.7 * columns, 3.0 * rows + 0.3), layout="constrained")
        axes = figure.subplots(2 * rows, columns, squeeze=False)
        for axis in axes.ravel():
            axis.set_visible(False)
        for k, name in enumerate(motions):
            above, below = axes[2 * (k // columns) : 2 * (k // columns) + 2, k % columns]
            _growth(above, found, name, meshes)
            image = _map(below, found[_series(meshes)[-1][1].format(name)]["places"])
            figure.colorbar(image, ax=below, shrink=0.8, aspect=12)
        figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=3)
        figure.supylabel(f"RMS, mm: over time; and over the fabric ({_series(meshes)[-1][0]})", fontsize=8)
        file = folder / "null.png"
        figure.savefig(file, dpi=100, metadata={"Software": None})
    return file


def _growth(axis: Any, found: dict[str, Any], name: str, meshes: Sequence[int]) -> None:
    for (label, key), colour in zip(_series(meshes), COLOURS, strict=False):
        values = 1e3 * np.asarray(found[key.format(name)]["frames"])
        axis.plot(PERIOD * np.arange(len(values)), values, color=colour, label=label, lw=1)
    axis.set_visible(True)
    axis.set_title(name)
    axis.set_ylim(bottom=0)
    axis.set_xlabel("t, s")


def _map(axis: Any, places: list[float]) -> Any:
    axis.set_visible(True)
    n = round(len(places) ** 0.5)
    image = axis.imshow(1e3 * np.asarray(places).reshape(n, n), origin="lower", cmap="viridis", vmin=0)
    axis.set_xticks([])
    axis.set_yticks([])
    return image
