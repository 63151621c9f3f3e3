"""Print a fit as tables for a terminal."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from .display_units import in_display_unit
from .result import Identification
from .tension.fit import TensionFit
from .uncertainty.estimates import Estimate

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

MIN_FIT_TABLE_COLUMNS = 112  # of the terminal
PARAMETER_COLUMN_SIDES = {
    "parameter": "left",
    "start": "right",
    "fitted": "right",
    "std. error": "right",
    "95 % interval": "right",
    "unit": "left",
    "": "left",
}
ERROR_KEYS = ("rms_before", "rms_after", "max_after")
SOURCE_REMARKS = {"prior": "measured", "derived": "= E h", "held fixed": "held fixed"}


def print_fit(fit: Identification) -> None:
    """Print warnings, parameters and distances, 112 columns wide or more."""
    from rich.console import Console

    console = Console(highlight=False)
    console.width = max(console.width, MIN_FIT_TABLE_COLUMNS)
    _print_notes(console, fit.warnings)
    absent = [name for name, e in fit.parameters.items() if e.source == "not in the model"]
    console.print(_parameters(fit.parameters, fit.is_withdrawn))
    if absent:
        console.print(f"Not in the model, because contact was left out: {', '.join(absent)}")
    _print_nuisances(console, fit)
    _print_profiles(console, fit)
    _print_influences(console, fit)
    console.print(_distances(fit.fit))
    f = fit.fit
    end = "" if f["converged"] else " (not converged)"
    points = f"{f['points']:.0f} points count as " if f["points"] else ""
    console.print(
        f"{f['iterations']:.0f} iterations{end}, {f['simulations']:.0f} simulations, {f['seconds']:.0f} s; "
        f"{points}{f['effective_observations']:.0f} effective observations"
    )


def _print_notes(console: Console, warnings: Sequence[str]) -> None:
    """Print what to mistrust in the numbers that follow."""
    for warning in warnings:
        console.print(f"note: {warning}", style="yellow", markup=False)


def _distances(f: dict[str, Any]) -> Table:
    """Distances of the null, the start and the end, and forces where there are any."""
    from rich import box
    from rich.markup import escape
    from rich.table import Table

    lengths = {"Chamfer [mm]": "chamfer", "rms [mm]": "rms"}
    forces = {"force rms [N]": "force_rms"} if "force_rms_after" in f else {}
    table = Table(title="Distance cloud to surface, one-sided", title_justify="left", box=box.SIMPLE_HEAD)
    for heading in ("", *lengths, *forces):
        table.add_column(escape(heading), justify="right" if heading else "left", no_wrap=True)
    for label, key in (
        ("null: carried rigidly, no force", "null"),
        ("start values", "before"),
        ("fitted values", "after"),
    ):
        distances = [f"{1e3 * f[f'{what}_{key}']:.3f}" for what in lengths.values()]
        errors = [f"{f[f'{what}_{key}']:.6f}" for what in forces.values()]
        table.add_row(label, *("–" if cell == "nan" else cell for cell in (*distances, *errors)))
    if forces:
        table.add_row("constant forces", "–", "–", f"{f['force_rms_constant']:.6f}")
    return table


def _print_profiles(console, fit: Identification) -> None:
    for name, profile in fit.profiles.items():
        low, high = ("open" if end is None else f"{end:.3g}" for end in profile.ci95)
        shape = "" if profile.skew is None else f", upper part {profile.skew:.2f} times the lower"
        console.print(f"profile of {name}: {low} … {high}{shape}", markup=False)


def _print_influences(console, fit: Identification) -> None:
    """Print how far parameters move the cloth, and what would determine those that are not identified."""
    from rich import box
    from rich.table import Table

    table = Table(title="What the data can determine", title_justify="left", box=box.SIMPLE_HEAD)
    for heading in ("parameter", "10 % moves the cloth by", "its forces by", "to determine it"):
        table.add_column(heading, justify="right" if "by" in heading else "left", no_wrap=heading == "parameter")
    for name, i in fit.influences.items():
        table.add_row(
            name, f"{i.displacement_per_10_percent_mm:.2g} mm", f"{i.force_per_10_percent_n:.2g} N", i.experiment
        )
    if fit.influences:
        console.print(table)
    determined = [c for c in fit.combinations if c.determined]
    if determined:
        console.print(
            "Known together: the data show the product to so many per cent; each of its factors may be less certain."
        )
    for c in determined:
        console.print(f"known together: {c.text}, to {100 * c.std:.2g} %", markup=False)


def _print_nuisances(console, fit: Identification) -> None:
    """Print the nuisances, one line per episode."""
    for episode, estimates in fit.nuisances.items():
        if estimates:
            numbers = [f"{name} {in_display_unit(e.unit, e.value, e.std)}" for name, e in estimates.items()]
            console.print(f"{episode}: {', '.join(numbers)}", markup=False)


def print_tension(fit: TensionFit) -> None:
    """Print warnings, parameters and errors of every table, 112 columns wide or more."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    console = Console(highlight=False)
    console.width = max(console.width, MIN_FIT_TABLE_COLUMNS)
    _print_notes(console, fit.warnings)
    console.print(_parameters(fit.parameters))
    table = Table(title="Errors, % of a table's largest reading", title_justify="left", box=box.SIMPLE_HEAD)
    for heading in ("table", "force rms: start", "fitted", "largest", "lateral strain rms: start", "fitted", "largest"):
        table.add_column(heading, justify="left" if heading == "table" else "right")
    for k, errors in enumerate(fit.errors):
        keys = [f"{kind}_{figure}" for kind in ("force", "lateral") for figure in ERROR_KEYS]
        table.add_row(str(k), *(f"{100 * errors[key]:.1f}" if key in errors else "" for key in keys))
    console.print(table)


def _parameters(estimates: dict[str, Estimate], withdrawn: bool = False) -> Table:
    """Estimates of the parameters that are in the model; intervals of fitted ones only if the fit means something."""
    from rich import box
    from rich.table import Table

    table = Table(title="Parameters", title_justify="left", box=box.SIMPLE_HEAD)
    for heading, side in PARAMETER_COLUMN_SIDES.items():
        table.add_column(heading, justify=side, no_wrap=True)  # type: ignore[arg-type]
    for name, e in estimates.items():
        if e.source != "not in the model":
            table.add_row(name, f"{e.initial:.4g}", *_statement(e, withdrawn), e.unit, _remark(e))
    return table


def _statement(e: Estimate, withdrawn: bool) -> tuple[str, str, str]:
    """(value, error, interval): no number without its error, and none where the data say nothing."""
    interval = "–" if withdrawn and e.source != "held fixed" else f"{e.ci95[0]:.3g} … {e.ci95[1]:.3g}"
    if not e.identifiable:
        return "–", "–", interval
    digits = math.floor(math.log10(abs(e.value) / e.std)) + 2 if e.std > 0 and e.value else 4
    return f"{e.value:.{min(max(digits, 3), 6)}g}", f"{e.std:.2g}", interval


def _remark(e: Estimate) -> str:
    if e.source in ("data", "prior") and not e.identifiable:
        return "not identifiable"
    return SOURCE_REMARKS.get(e.source, "")
