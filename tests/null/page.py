"""The null as a table and as a picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchcloth.identification.result import write_atomically

COLOURS = {"true": "#1f6f8b", "finer": "#8fc1d0", "fitted": "#b0653a"}


def table(found: dict[str, Any], motions: Sequence[str], meshes: Sequence[int]) -> str:
    """Markdown: a row for each motion, distances in mm."""
    columns = [f"true values, {n} x {n}" for n in meshes] + [f"fitted, {meshes[0]} x {meshes[0]}", "truth coarser"]
    rows = [
        "| motion | fastest point, m/s | " + " | ".join(columns) + " |",
        "|---|---" + "|---" * len(columns) + "|",
    ]
    for name in motions:
        cells = [_cell(found.get(f"true {name} {n}")) for n in meshes] + [
            _cell(found.get(f"fitted {name} {meshes[0]}"))
        ]
        own = found.get(f"truth {name}")
        cells.append("" if own is None else f"{1e3 * own:.2f}")
        rows.append(f"| {name} | {found[f'episode {name}']:.2f} | " + " | ".join(cells) + " |")
    return "\n".join(rows)


def parameters(found: dict[str, Any]) -> str:
    """Markdown: what the fit found beside the truth."""
    units = {"membrane_stiffness": "N/m", "poisson_ratio": "-", "bending_stiffness": "N m", "damping_time": "s"}
    fit = found["fit"]
    rows = ["| parameter | truth | fitted |", "|---|---|---|"]
    rows += [f"| {key} [{unit}] | {fit['true'][key]:.3g} | {fit['values'][key]:.3g} |" for key, unit in units.items()]
    return "\n".join(rows)


def _cell(distance: dict[str, Any] | None) -> str:
    return "" if distance is None else f"{1e3 * distance['material']:.2f} ({1e3 * distance['surface']:.2f})"


def write(found: dict[str, Any], motions: Sequence[str], meshes: Sequence[int], folder: Path) -> Path:
    """``folder``/null.md."""
    text = f"{table(found, motions, meshes)}\n\n{parameters(found)}\n"
    return write_atomically(folder / "null.md", text)


def draw(found: dict[str, Any], motions: Sequence[str], folder: Path) -> Path:
    """``folder``/null.png: how the distance grows with time, and where in the fabric it is."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    meshes = sorted({int(key.split()[2]) for key in found if key.startswith("true ")})
    style = {"font.size": 7, "axes.spines.top": False, "axes.spines.right": False, "legend.frameon": False}
    with rc_context(style):
        figure = Figure(figsize=(1.35 * len(motions) + 0.6, 3.1), layout="constrained")
        axes = figure.subplots(2, len(motions), squeeze=False)
        highest = max(np.max(found[f"true {m} {meshes[0]}"]["frames"]) for m in motions)
        for k, name in enumerate(motions):
            _growth(axes[0, k], found, name, meshes, 1e3 * highest)
            image = _map(axes[1, k], found[f"true {name} {meshes[-1]}"]["places"])
            figure.colorbar(image, ax=axes[1, k], shrink=0.7, aspect=12)
        axes[0, 0].set_ylabel("RMS, mm")
        axes[0, 0].legend(loc="upper left", fontsize=6)
        axes[1, 0].set_ylabel(f"v, {meshes[-1]} x {meshes[-1]}, mm")
        file = folder / "null.png"
        figure.savefig(file, dpi=110, metadata={"Software": None})
    return file


def _growth(axis: Any, found: dict[str, Any], name: str, meshes: Sequence[int], highest: float) -> None:
    series = {f"{meshes[0]} x {meshes[0]}": ("true", f"true {name} {meshes[0]}")}
    if len(meshes) > 1:
        series[f"{meshes[-1]} x {meshes[-1]}"] = ("finer", f"true {name} {meshes[-1]}")
    series["fitted"] = ("fitted", f"fitted {name} {meshes[0]}")
    for label, (colour, key) in series.items():
        values = 1e3 * np.asarray(found[key]["frames"])
        axis.plot(0.02 * np.arange(len(values)), values, color=COLOURS[colour], label=label, lw=1)
    axis.set_title(name)
    axis.set_ylim(0, 1.05 * highest)
    axis.set_xlabel("t, s")


def _map(axis: Any, places: list[float]) -> Any:
    n = round(len(places) ** 0.5)
    image = axis.imshow(1e3 * np.asarray(places).reshape(n, n), origin="lower", cmap="viridis", vmin=0)
    axis.set_xticks([])
    axis.set_yticks([])
    return image
