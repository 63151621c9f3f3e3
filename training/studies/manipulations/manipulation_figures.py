"""Figures of the studies garments, chamfer and factors."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchcloth._utils.files import write_atomically

from . import paper_tables
from .cases import PAPER_PARAMETERS
from .measures import Pooled
from .scenes import ACTIONS, STUDY_GARMENTS

ACTION_COLOURS = {"cover": "#1f6f8b", "fling": "#b0653a", "drag": "#3d7f3d"}
PARAMETER_SYMBOLS = {"youngs_modulus": "E", "poisson_ratio": "ν", "contact_stiffness": "k", "shear_stiffness": "γ"}
STATE_LABELS = {"null": "rigid carry", "start": "not fitted", "fit": "fitted"}
STATE_COLOURS = {"null": "#bbbbbb", "start": "#8fb8c8", "fit": "#1f6f8b"}


def estimates(results: dict[str, dict[str, Any]], path: Path) -> None:
    """Draw all estimates divided by their truth, with 95 % intervals; hollow and grey if not identifiable."""
    cases = [case for case in results.values() if "estimates" in case]
    worn = [name for name in STUDY_GARMENTS if any(c["manipulation"]["garment"] == name for c in cases)]
    if not worn:
        return
    figure, axes = _figure(len(PAPER_PARAMETERS), 1.6 + 1.0 * len(worn))
    for axis, name in zip(axes, PAPER_PARAMETERS, strict=True):
        for row, garment in enumerate(worn):
            group = [c for c in cases if c["manipulation"]["garment"] == garment]
            for i, case in enumerate(group):
                _estimate(axis, case, name, row + (0.75 * (i / (len(group) - 1) - 0.5) if len(group) > 1 else 0.0))
        axis.axvline(1.0, color="black", linewidth=0.8)
        axis.set(title=PARAMETER_SYMBOLS[name], xscale="log", xlim=(0.05, 20), xlabel="estimate / truth")
        axis.set(yticks=range(len(worn)), ylim=(len(worn) - 0.5, -0.5), yticklabels=worn if axis is axes[0] else [])
    for action, colour in ACTION_COLOURS.items():
        axes[0].plot([], [], "o-", color=colour, label=f"{action}, with 95 % interval")
    axes[0].plot([], [], "o-", color="#bbbbbb", markerfacecolor="none", label="not identifiable")
    figure.legend(fontsize=8, loc="outside lower center", ncols=4)
    _save(figure, path)


def _estimate(axis: Any, case: dict[str, Any], name: str, place: float) -> None:
    e, truth = case["estimates"][name], case["truth"][name]
    colour = ACTION_COLOURS[case["manipulation"]["action"]] if e["identifiable"] else "#bbbbbb"
    low, high = (max(end / truth, 1e-9) for end in e["ci95"])
    axis.plot([low, high], [place, place], "-", color=colour, linewidth=1, zorder=1)
    face = colour if e["identifiable"] else "none"
    axis.plot(e["value"] / truth, place, "o", color=colour, markerfacecolor=face, markersize=4, zorder=2)


def distances(result: dict[str, dict[str, Any]], path: Path) -> None:
    """Draw both Chamfer conventions by action and by garment, with the paper's means."""
    if not any(result.values()):
        return
    figure, axes = _figure(2, 3.8)
    for axis, (by, names) in zip(axes, (("action", ACTIONS), ("garment", STUDY_GARMENTS)), strict=True):
        rows = {name: result[by][name] for name in names if name in result[by]}
        for i, (name, conventions) in enumerate(rows.items()):
            for j, (convention, hatch) in enumerate((("surface", ""), ("vertices", "//"))):
                for k, (state, colour) in enumerate(STATE_COLOURS.items()):
                    label = f"{STATE_LABELS[state]}, to {convention}" if i == 0 else None
                    value = 1e3 * conventions[convention][state]["mean"]
                    place = i + 0.12 * (3 * j + k - 3)
                    axis.bar(place, value, 0.11, color=colour, hatch=hatch, edgecolor="white", label=label)
            axis.plot(
                i + 0.43, 1e3 * paper_tables.CHAMFER[name][0], "D", color="#b0653a", label="paper" if i == 0 else None
            )
        axis.set(title=f"by {by}", xticks=range(len(rows)), xticklabels=list(rows), yscale="log", ylim=(0.8, 200))
        axis.set(yticks=(1, 3, 10, 30, 100), yticklabels=(1, 3, 10, 30, 100))
        axis.minorticks_off()
    axes[0].set_ylabel("mean Chamfer distance [mm]")
    figure.legend(*axes[0].get_legend_handles_labels(), fontsize=8, loc="outside lower center", ncols=4)
    _save(figure, path)


def levels(factors: Mapping[str, Pooled], path: Path) -> None:
    """Draw mean and standard deviation of the distance at each level."""
    if not any(p.levels for p in factors.values()):
        return
    figure, axes = _figure(len(factors), 3.2)
    for axis, (factor, p) in zip(axes, factors.items(), strict=True):
        names = list(p.levels)
        means = [1e3 * group.mean for group in p.levels.values()]
        spreads = [1e3 * group.mean * (0.0 if group.count < 2 else group.cov) for group in p.levels.values()]
        axis.errorbar(range(len(names)), means, spreads, fmt="o", color="#1f6f8b", capsize=4)
        axis.axhline(1e3 * p.mean, color="#bbbbbb", linewidth=1)
        axis.set(
            title=factor, xticks=range(len(names)), xticklabels=names, xlim=(-0.5, len(names) - 0.5), ylim=(0, None)
        )
    axes[0].set_ylabel("Chamfer of the fitted cloth,\ncloud to surface [mm]")
    _save(figure, path)


def _figure(columns: int, height: float) -> tuple[Any, Any]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(3.6 * columns if columns > 2 else 11, height), layout="constrained")
    return figure, figure.subplots(1, columns)


def _save(figure: Any, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with write_atomically(path) as part:
        figure.savefig(part, dpi=110)
