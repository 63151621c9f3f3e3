"""Figures of the fabric study: the experiment from above, and the error of each trial."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from torchcloth._utils.files import write_atomically

from . import stretching
from .fabric_trials import Scale, seed_of, sheet_fabric, true_values
from .paper_fabrics import COV, FABRICS, SYMBOLS
from .stretching import Pull

KIND_COLOURS = {"x": "#1f6f8b", "y": "#b0653a", "45": "#3d7f3d", "press": "#1f6f8b", "elsewhere": "#b0653a"}
KIND_LABELS = {
    "band": "the paper's CoV",
    "x": "pulled along x",
    "y": "along y",
    "45": "at 45°",
    "press": "pressed",
    "elsewhere": "pressed elsewhere in the grid",
}


def draw(folder: Path, scale: Scale, cases: Mapping[str, Mapping[str, Any]]) -> list[Path]:
    """Write stretching.png and fabrics.png; return their paths."""
    figures = {"stretching.png": _experiment(scale), "fabrics.png": _errors(scale, cases)}
    for name, figure in figures.items():
        with write_atomically(folder / name) as part:
            figure.savefig(part, dpi=110, bbox_inches="tight")
    return [folder / name for name in figures]


def _experiment(scale: Scale) -> Any:
    """Draw first and last frame of one trial in each direction, from above."""
    from matplotlib.figure import Figure

    shown = {pull.direction: pull for pull in reversed(scale.pulls)}
    figure = Figure(figsize=(4.2 * len(shown), 4.2), layout="constrained")
    axes = figure.subplots(1, len(shown), squeeze=False, sharex=True, sharey=True)[0]
    for axis, (direction, pull) in zip(axes, sorted(shown.items(), reverse=True), strict=True):
        _trial(axis, scale, pull)
        axis.set_title(f"{FABRICS[scale.fabrics[0]]}, pulled along {direction if direction != '45' else '45°'}")
    axes[0].set_ylabel("y [m]")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=8)
    return figure


def _trial(axis: Any, scale: Scale, pull: Pull) -> None:
    name = scale.fabrics[0]
    recording = stretching.record_trial(sheet_fabric(name), pull, seed_of(name, 0), scale.detail)
    points, markers = recording.points, recording.markers
    if points is None or markers is None:
        raise RuntimeError("a trial without points")  # what record always gives
    last = len(points.t) - 1
    way = markers.xyz[last] - markers.xyz[0]
    axis.plot(*points.frame(last)[:, :2].T, ".", ms=3, color="#9db8c4", label="points of the last frame")
    axis.quiver(*markers.xyz[0][:, :2].T, *way[:, :2].T, angles="xy", scale_units="xy", scale=1, width=2.5e-3)
    axis.plot(*markers.xyz[0][:, :2].T, ".", ms=2, color="black", label="markers and their motion")
    for grip, colour in (("still", "#444444"), ("moving", "#c0392b")):
        clamp_points = recording.grasps[grip].uv
        if clamp_points is not None:
            path = recording.grippers[grip].position
            origin = pull.size * (np.arange(2) == 1 - pull.axis) / 2
            origin = origin + pull.size * (np.arange(2) == pull.axis) * (grip == "moving")
            line = clamp_points - origin + path[-1][:2]
            axis.plot(*line.T, color=colour, lw=4, solid_capstyle="butt", label=f"{grip} clamp")
    axis.set(aspect="equal", xlabel="x [m]")


def _errors(scale: Scale, cases: Mapping[str, Mapping[str, Any]]) -> Any:
    """Draw the errors of E and nu from stretching trials, and of k and gamma from presses."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(2.4 + 2.1 * len(scale.fabrics), 10.0), layout="constrained")
    for axis, (symbol, parameter) in zip(figure.subplots(4, 1), SYMBOLS.items(), strict=True):
        for place, name in enumerate(scale.fabrics):
            cov = COV[name][symbol]
            axis.fill_between(
                [place - 0.42, place + 0.42], -cov, cov, color="#e8e8e8", lw=0, label=_legend_label(axis, "band")
            )
            _points(axis, place, name, parameter, cases)
        axis.axhline(0.0, color="black", lw=0.8)
        axis.set(xticks=range(len(scale.fabrics)), ylabel=f"{symbol}: error [%]")
        axis.set_xticklabels([FABRICS[name] for name in scale.fabrics])
        axis.margins(y=0.25)
        axis.legend(fontsize=7, loc="upper right", ncols=4)
    return figure


def _legend_label(axis: Any, kind: str) -> str | None:
    """Return the label of a kind if the legend does not have it yet."""
    drawn = axis.get_legend_handles_labels()[1]
    return None if KIND_LABELS[kind] in drawn else KIND_LABELS[kind]


def _points(axis: Any, place: int, name: str, parameter: str, cases: Mapping[str, Mapping[str, Any]]) -> None:
    selected = {
        key: c for key, c in cases.items() if key.startswith(name) and _kind(key) and parameter in c["parameters"]
    }
    for i, (key, case) in enumerate(selected.items()):
        e, kind = case["parameters"][parameter], case.get("direction", _kind(key))
        if not e["identifiable"]:
            continue
        error_percent, bar = (
            100 * (e["value"] / true_values(name)[parameter] - 1),
            100 * e["std"] / true_values(name)[parameter],
        )
        at = place + 0.7 * ((i + 0.5) / len(selected) - 0.5)
        axis.errorbar(at, error_percent, bar, fmt="o", ms=4, color=KIND_COLOURS[kind], label=_legend_label(axis, kind))


def _kind(key: str) -> str:
    """Return "pull", "press" or "elsewhere"; empty for other cases."""
    return next((kind for kind in ("pull", "press", "elsewhere") if f"-{kind}-" in key), "")
