"""Tables and a figure of swings and carries with the times of single frames as unknowns."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torchcloth._utils.files import save_figure
from torchcloth.identification.pictures import AFTER_COLOUR, BEFORE_COLOUR

from .measured_figures import make_figure
from .measured_tables import make_console, make_table
from .timed import TIMED_UNITS

TIMED_LABELS = {
    "null": "null: carried rigidly",
    "no memory": "drag, added mass, linear damping",
    "entrained": "drag, air that follows with a delay",
}
TIMED_COLOURS = {"no memory": BEFORE_COLOUR, "entrained": AFTER_COLOUR}
OFFSET_LABELS = {"none": "none", "still": "of each run before its motion", "fitted": "of the fitted runs"}
SWING_MARK_MM, CARRY_MARK_MM = (9.0, 15.0), (8.0, 12.0)  # all nodes, lower edge: the aims of the study


def print_tables(result: dict[str, Any]) -> None:
    """Print ratios, predictions of swings and of carries, and the parts of the residual."""
    console, timed = make_console(), result["timed"]
    table = make_table(f"Swings with times of single frames: {len(timed['fitted_runs'])} runs fitted")
    for heading in ("", *(TIMED_LABELS[label] for label in timed["fits"]), "unit"):
        table.add_column(heading, justify="left" if heading in ("", "unit") else "right")
    for name, unit in TIMED_UNITS.items():
        cells = []
        for content in timed["fits"].values():
            e = content["ratios"].get(name)
            cells.append("" if e is None else f"{e['value']:.3g} ± {e['std']:.2g} ({e['low']:.3g} … {e['high']:.3g})")
        table.add_row(name, *cells, unit)
    console.print(table)
    console.print(_predictions(f"{len(timed['predicted_runs'])} swings predicted, whole", timed))
    if "carries" in result:
        console.print(_predictions("Carries predicted with the fits to the swings, whole", result["carries"]))
    for label, row in timed["free_swings"].items():
        name = TIMED_LABELS.get(label, label)
        console.print(f"free swings, {name}: {row['frequency']:.3f} Hz, decay {row['decay']:.1f} 1/(m s)")
    table = make_table("Swings predicted: what each part of the distance is; mm, all nodes and lower edge")
    for heading in ("step", *(TIMED_LABELS[label] for label in timed["parts"])):
        table.add_column(heading, justify="left" if heading == "step" else "right")
    for step in next(iter(timed["parts"].values())):
        table.add_row(step, *(_pair(part[step]) for part in timed["parts"].values()))
    table.add_row("standing nodes, less their offsets: noise", *[_pair(timed["standing"])] * len(timed["parts"]))
    console.print(table)
    console.print("times of frames from all nodes use the free cloth: no prediction, but what errors of times leave")


def _predictions(title: str, part: dict[str, Any]) -> Any:
    count, clock = part["frames"], part["clock"]
    rejected = f"{count['rejected_by_arc']} by arcs, {count['rejected_by_edge']} by the upper edge"
    title = (
        f"{title}: {count['used']} of {count['all']} frames (rejected {rejected}); lag "
        f"{clock['lag'][0]:.3f} s behind the stamp before, jitter {1e3 * clock['jitter_std'][0]:.0f} ms, camera turned "
        f"by {clock['camera_turn_deg'][0]:.1f}°"
    )
    table = make_table(title)
    for heading in ("offsets of nodes", "model", "all nodes mm", "lower edge mm", "median mm", "free swings mm"):
        table.add_column(heading, justify="right" if "mm" in heading else "left")
    for kind, label in OFFSET_LABELS.items():
        for model, model_label in TIMED_LABELS.items():
            if kind in part["models"][model]:
                row = part["models"][model][kind]
                cells = [f"{1e3 * row[key]:.1f}" for key in ("all", "lower", "median")]
                table.add_row(label, model_label, *cells, _pair(row["free"]) if "free" in row else "")
    return table


def _pair(row: dict[str, float]) -> str:
    return f"{1e3 * row['all']:.1f}, {1e3 * row['lower']:.1f}"


def draw(result: dict[str, Any], path: Path) -> Path:
    """Draw the lower edge of a predicted swing and a predicted carry, and the parts of the swings' residual."""
    pictures = [result[key]["picture"] for key in ("timed", "carries") if key in result]
    figure, axes = make_figure(1, len(pictures) + 1, (5.6 * (len(pictures) + 1), 4.4))
    for axis, picture in zip(axes[0], pictures, strict=False):
        for label, colour in TIMED_COLOURS.items():
            axis.plot(*_curve(picture[label]), color=colour, lw=1, label=TIMED_LABELS[label])
        axis.plot(*_curve(picture["measured"]), ".", color="black", markersize=4, label="measured")
        axis.set_xlim(0, picture["measured"]["t"][-1])
        axis.set(title=f"predicted: {picture['run'][-28:]}", xlabel="time [s]", ylabel="lower edge from upper [mm]")
        axis.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=3, columnspacing=1)
    axis = axes[0, -1]
    for label, colour in TIMED_COLOURS.items():
        steps = result["timed"]["parts"][label]
        for key, marker in (("all", "o"), ("lower", "s")):
            values = [1e3 * row[key] for row in steps.values()]
            name = "all nodes" if key == "all" else "lower edge"
            axis.plot(values, [-k for k in range(len(values))], marker + "-", color=colour, lw=0.7, label=f"{name}")
    for mark, style in zip(SWING_MARK_MM, ("-", "--"), strict=True):
        axis.axvline(mark, color="black", lw=0.6, ls=style)
    axis.set_yticks([-k for k in range(len(steps))], [_wrap(step) for step in steps], fontsize=7)
    axis.set(xlabel="RMS normal to the cloth [mm]", title="swings predicted: what each part is", xlim=(0, None))
    axis.legend(fontsize=7, loc="lower right")
    return save_figure(figure, path)


def _curve(series: dict[str, list[Any]]) -> tuple[list[float], list[float]]:
    """Return times [s] and displacements [mm]; null becomes NaN."""
    return series["t"], [float("nan") if y is None else 1e3 * y for y in series["y"]]


def _wrap(text: str, width: int = 24) -> str:
    import textwrap

    return "\n".join(textwrap.wrap(text, width))
