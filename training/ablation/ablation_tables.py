"""Tables of the ablation, with the paper's numbers."""

from __future__ import annotations

from typing import Any

from .measures import CHAOS_FACTOR, LEFT_OUT_TERMS
from .paper_tables import CHAMFER, ENERGY
from .runs import SceneName
from .scenes import COROTATED, LEVELS, PARAMETERS, PERTURBED, Variant

INERT_DISTANCE_CM = 1e-9  # rounding


def print_study(
    result: dict[str, Any],
    distance: dict[str, dict[Variant, float]],
    energy: dict[str, dict[str, float]],
    measured: dict[SceneName, dict[str, Any]],
) -> None:
    """Print all tables and the summary, at least 118 columns wide."""
    from rich.console import Console

    console = Console(highlight=False)
    console.width = max(console.width, 118)
    console.print(_distances(distance))
    console.print(
        f"(In brackets: less than {CHAOS_FACTOR:g} times the effect of a start moved by 1 um. Distances are between "
        f"final shapes at scale {result['setup']['scale']:g}. The paper gives neither a unit nor such a bound.)\n"
    )
    console.print(_scenes(measured))
    inert = [
        " ".join(scene) for scene, entry in measured.items() if entry["final"].get(COROTATED, 1.0) < INERT_DISTANCE_CM
    ]
    if inert:
        console.print(
            f"No layers touched in {', '.join(inert)}, so k and gamma had no effect. Contact acts only between "
            "triangles that are more than about nine edges apart along the cloth; take more triangles.\n"
        )
    console.print(_energy(energy))
    for line in _summary(result):
        console.print(line)


def _table(title: str, *headings: str):
    from rich import box
    from rich.markup import escape
    from rich.table import Table

    table = Table(title=escape(title), title_justify="left", box=box.SIMPLE_HEAD, min_width=len(title))
    for heading in headings:
        table.add_column(heading, justify="right" if heading and heading != "scene" else "left", no_wrap=True)
    return table


def _distances(distance: dict[str, dict[Variant, float]]):
    levels = sorted({v.level for row in distance.values() for v in row if v.parameter in PARAMETERS})
    headings = [f"{level} %" for level in levels]
    table = _table("Bidirectional Chamfer distance [cm]: ours | the paper's", "", *headings, "|", *headings)
    for action, row in distance.items():
        for p in PARAMETERS:
            ours = [_cell(row, Variant(p, level)) for level in levels]
            paper = [f"{CHAMFER[action][p][LEVELS.index(level)]:.2f}" for level in levels]
            table.add_row(f"{action} {p}", *ours, "|", *paper, end_section=p == "gamma")
    return table


def _cell(row: dict[Variant, float], variant: Variant) -> str:
    if variant not in row:
        return "–"
    text = f"{row[variant]:.3f}"
    return f"({text})" if row[variant] < CHAOS_FACTOR * row.get(PERTURBED, 0.0) else text


def _scenes(measured: dict[SceneName, dict[str, Any]]):
    headings = ("start moved 1 um", "k = gamma = 0", *(f"largest of {p}" for p in PARAMETERS))
    table = _table("Per scene [cm]", "scene", *headings)
    for scene, entry in measured.items():
        row = entry["final"]
        largest = [max([d for v, d in row.items() if v.parameter == p], default=None) for p in PARAMETERS]
        references = [row.get(PERTURBED), row.get(COROTATED)]
        table.add_row(" ".join(scene), *("–" if d is None else f"{d:.2g}" for d in (*references, *largest)))
    return table


def _energy(energy: dict[str, dict[str, float]]):
    headings = [text for action in energy for text in (action, "paper")]
    table = _table("Share of the elastic energy [%]", "", *headings)
    for j in LEFT_OUT_TERMS:
        cells = []
        for action, row in energy.items():
            cells += [f"{100 * row[j]:z.1f}", f"{ENERGY[action][j]:.1f}" if j in ENERGY[action] else ""]
        table.add_row(j, *cells)
    return table


def _summary(result: dict[str, Any]) -> list[str]:
    agreement = result["agreement"]
    lines = [f"runs: {result['runs']['finished']} of {result['runs']['of']}"]
    for key, what in (("chamfer", "distances"), ("chamfer_mean", "mean over frames"), ("energy", "shares of energy")):
        shown = ", ".join(f"{action} {_number(rank)}" for action, rank in agreement[key].items())
        lines.append(f"rank correlation with the paper (Spearman), {what}: {shown}")
    beyond = ", ".join(f"{action} {n} of {of}" for action, (n, of) in agreement["beyond_chaos"].items())
    lines.append(f"distances above {CHAOS_FACTOR:g} times the effect of a start moved by 1 um: {beyond}")
    for action, order in agreement["order"].items():
        lines.append(
            f"{action}, by mean distance: ours {' > '.join(order['ours'])}; paper {' > '.join(order['paper'])}"
        )
    return lines


def _number(rank: float) -> str:
    return "undefined" if rank != rank else f"{rank:.2f}"
