"""Tables of the study of measured cloth, for each source."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from .swings import NOMINAL_DENSITY_KG_PER_M2, RATIO_UNITS
from .tension import MAX_ROBOT_FORCE_N

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

MODEL_LABELS = {
    "measured": "measured",
    "still": "nodes before the motion: noise",
    "null": "null: carried rigidly",
    "vacuum": "vacuum",
    "textbook": "textbook air: C_n 1.2, depth 0.377 L",
    "whole": "fitted to whole runs",
    "free": "matched to the free swings",
}


def nylon(result: dict[str, Any], folder: Path) -> None:
    """Print fits of four angles, predictions of each from the other three, and angles between."""
    console = make_console()
    table = make_table("Nylon in tension: error of the force, % of the curve's largest reading")
    for heading in (
        "angle",
        "fitted: rms",
        "max",
        "from the other three: rms",
        "max",
        "readings inside 95 %",
        "the law's part from",
    ):
        table.add_column(heading, justify="left" if heading.startswith("the") else "right")
    for angle, fitted in result["fitted"].items():
        left = result["left_out"][angle]
        entry, other = fitted["measured"]["force"], left["measured"]["force"]
        numbers = [_percent(entry["rms"]), _percent(entry["max"]), _percent(other["rms"]), _percent(other["max"])]
        notes = [left["misfit_source"].replace("tables at ", "").replace(", each left out of the fit", "")]
        notes += ["outside of the fitted angles"] if any("outside" in w for w in left["warnings"]) else []
        notes += [f"{name} not identifiable" for name in left["not_identifiable"]]
        table.add_row(f"{angle}°", *numbers, f"{100 * other['coverage']:.0f} %", "; ".join(notes))
    console.print(table)
    table = make_table("Nylon at angles that were not measured here: force [N], and the standard deviation's parts")
    for heading in ("angle", "strain", "force", "by parameters", "by the law", "by the preload", "95 % interval"):
        table.add_column(heading, justify="right")
    for angle, curve in result["between"].items():
        for k, r in enumerate(curve):
            parts = [f"± {r[part]:.2f}" for part in ("parameters", "law", "setup")]
            interval = f"{r['low']:.2f} … {r['high']:.2f}"
            strain = f"{100 * r['strain']:.0f} %"
            table.add_row("" if k else f"{angle}°", strain, f"{r['force']:.2f}", *parts, interval)
    console.print(table)
    console.print(f"any other angle: torchcloth predict {folder} --angle DEGREES", markup=False)


def knits(result: dict[str, Any]) -> None:
    """Print predictions of third pulls from the first two, with the scatter between pulls."""
    table = make_table(
        f"Knits up to {MAX_ROBOT_FORCE_N:g} N: third pull from the first two, rms in % of its largest reading"
    )
    for heading in (
        "fabric",
        "along",
        "force",
        "repeats differ",
        "in 95 %",
        "lateral",
        "repeats differ",
        "in 95 %",
        "nu",
    ):
        table.add_column(heading, justify="left" if heading == "fabric" else "right", no_wrap=True)
    for name, fabric in result.items():
        nu = fabric["poisson_ratio"]
        for label, one in fabric["directions"].items():
            judged, floor = one["prediction"]["measured"], one["floor"]
            cells = []
            for kind in ("force", "lateral"):
                entry = judged[kind]
                cells += [_percent(entry["rms"]), _percent(floor[kind]), f"{100 * entry['coverage']:.0f} %"]
            ratio = f"{nu['value']:.3f} ± {nu['std']:.3f}" if nu["identifiable"] else "not identifiable"
            table.add_row(
                name.replace("_Yarn", "").replace("_", " ") if label == "X" else "",
                label,
                *cells,
                ratio if label == "X" else "",
            )
    console = make_console()
    console.print(table)
    console.print(
        "repeats differ: difference of the third pull from the mean of the first two, the noise floor of any law "
        "fitted to them. in 95 %: fraction of readings in the interval. nu: symmetric Poisson's ratio"
    )


def swings(result: dict[str, Any]) -> None:
    """Print ratios to the areal density, then the predictions."""
    console = make_console()
    title = f"IRI swings: {len(result['fitted_runs'])} runs fitted. Only ratios to the areal density are identifiable"
    table = make_table(title)
    for heading in ("", "whole runs, by identify", "frequency and decay of the free swings", "unit"):
        table.add_column(heading, justify="left" if heading in ("", "unit") else "right")
    for name, unit in RATIO_UNITS.items():
        cells = [_estimate(fit["ratios"].get(name)) for fit in result["fits"].values()]
        table.add_row(name, *cells, unit)
    console.print(table)
    console.print(
        "C_n, the depth of air and the areal density are confounded (density set to "
        f"{NOMINAL_DENSITY_KG_PER_M2:g} kg/m^2): drag is rho C_n / rho_A, added mass is rho depth / rho_A. ±: "
        "jackknife for whole runs, bootstrap for free swings"
    )
    predicted = result["predicted"]
    table = make_table(f"IRI swings: {len(result['predicted_runs'])} runs predicted; ± by bootstrap over these runs")
    for heading in ("", "node rms mm", "median mm", "swing Hz", "decay 1/(m s)"):
        table.add_column(heading, justify="right" if heading else "left")
    for key, label in MODEL_LABELS.items():
        p = predicted[key]
        near = (
            [f"{1e3 * p['rms']:.1f} ± {1e3 * p['rms_std']:.1f}", f"{1e3 * p['median']:.1f}"] if "rms" in p else ["", ""]
        )
        swing = [f"{p[k]:.{d}f} ± {p[k + '_std']:.{d}f}" if k in p else "" for k, d in (("frequency", 3), ("decay", 1))]
        table.add_row(label, *near, *swing)
    console.print(table)
    console.print("decay: B of A' = -B A^2, the fall of the amplitude A under quadratic drag")


def sample(result: dict[str, Any]) -> None:
    """Print the distances of all models in both directions."""
    console, e = make_console(), result["stiffness"]
    table = make_table(f"The paper's sample: {result['points']} points, mean distances in mm")
    for heading in ("", "cloud to surface", "cloud to vertices", "vertices to cloud"):
        table.add_column(heading, justify="right" if heading else "left")
    for name, row in result["distances"].items():
        table.add_row(name, *(f"{1e3 * value:.1f}" for value in row.values()))
    console.print(table)
    stated = f"{e['value']:.0f} ± {e['std']:.0f} N/m" if e["identifiable"] else "not identifiable from these points"
    console.print(f"membrane stiffness E h: {stated} (95 % {e['ci95'][0]:.3g} … {e['ci95'][1]:.3g} N/m)", markup=False)
    console.print("vertices to cloud: limited by the clouds' 31 points, which leave most of the dress unseen")


def _estimate(e: dict[str, Any] | None) -> str:
    if e is None:
        return "left out"
    interval = f"({e['low']:.3g} … {e['high']:.3g})"
    return f"{e['value']:.3g} ± {e['std']:.2g} {interval}" if e["identifiable"] else f"not identifiable {interval}"


def _percent(share: float) -> str:
    return f"{100 * share:.1f}"


def make_console() -> Console:
    """Make a console that is wide enough for the tables."""
    from rich.console import Console

    console = Console(highlight=False)
    console.width = max(console.width, 132)
    return console


def make_table(title: str) -> Table:
    """Make a table without columns."""
    from rich import box
    from rich.table import Table

    return Table(title=title, title_justify="left", box=box.SIMPLE_HEAD)
