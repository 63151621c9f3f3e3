"""``torchcloth identify --fields``: fit one value per triangle instead of one for the whole cloth."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .._utils.files import PROGRESS_FOLDER_NAME
from ..errors import InvalidInput
from .output_paths import replacement_note

if TYPE_CHECKING:
    from ..cloth import Cloth
    from ..identification.fields import FieldFit
    from ..recordings import Recording

SINGLE_VALUE_OPTIONS = (
    "fit",
    "starts",
    "profile",
    "nuisance",
    "prior",
    "refine",
    "method",
    "stop",
)  # without --fields only


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options of fields."""
    parser.add_argument(
        "--fields",
        nargs="+",
        metavar="NAME",
        help="fit a smooth field, one value per triangle, of each named material parameter; without standard errors",
    )
    parser.add_argument(
        "--contrast",
        type=float,
        metavar="X",
        help="expected contrast of a field: a factor of e^X from side to side (default: 1)",
    )


def check(options: argparse.Namespace, defaults: argparse.Namespace) -> None:
    """Check that options of fields and of single values are not mixed.

    Raises:
        InvalidInput: an option that does not go with ``--fields``, or ``--contrast`` without it.
    """
    if options.fields is None:
        if options.contrast is not None:
            raise InvalidInput("--contrast", got=options.contrast, expected="--fields as well")
        return
    for name in SINGLE_VALUE_OPTIONS:
        if getattr(options, name) != getattr(defaults, name):
            raise InvalidInput(f"--{name}", got="a value, with --fields", expected="one of them")


def make_fields(cloth: Cloth, names: list[str]) -> None:
    """Turn material parameters into fields with one value per triangle, equal at first.

    Raises:
        InvalidInput: the material has no such parameter.
    """
    from ..parameters import PhysicalParameter

    known = {name: p for name, p in cloth.material.named_modules() if isinstance(p, PhysicalParameter)}
    known = {name: p for name, p in known.items() if p.domain != "nonnegative"}
    for name in names:
        if name not in known:
            raise InvalidInput("--fields", got=repr(name), expected=f"one of {', '.join(sorted(known))}")
        known[name].raw.data = known[name].raw.detach().expand(len(cloth.mesh.faces)).clone()


def fit(options: argparse.Namespace, cloth: Cloth, episodes: list[Recording], journal: Path, advance: Any) -> FieldFit:
    """Fit the fields to the episodes.

    Args:
        options: of the command line.
        cloth: with fields, see ``make_fields``.
        episodes: recordings of the cloth.
        journal: folder in which the progress is stored.
        advance: called after each iteration.
    """
    from ..identification import fit_fields

    contrast = {} if options.contrast is None else {"contrast": options.contrast}
    return fit_fields(
        cloth,
        episodes,
        options.fields,
        iterations=options.iterations,
        dt=options.dt,
        use=options.use,
        journal=journal,
        resume=options.resume or None,
        on_progress=advance,
        **contrast,
    )


def report(folder: Path, fit: FieldFit, cloth: Cloth) -> int:
    """Print a table and write fields.json and fields.png.

    Returns:
        Exit code 0.
    """
    from rich import box
    from rich.console import Console
    from rich.table import Table

    from .._utils.files import save_figure
    from .._utils.resume import clear_store
    from ..identification.fields import FIELDS_FILE_NAME
    from ..identification.pictures import plot_fields

    note = replacement_note(folder / FIELDS_FILE_NAME)
    path = fit.save(folder)
    picture = save_figure(plot_fields(fit.fields, cloth), folder / "fields.png")
    clear_store(folder / PROGRESS_FOLDER_NAME)  # before anything is printed, to somebody who may stop reading
    console = Console(highlight=False)
    for warning in fit.warnings:
        console.print(f"note: {warning}", style="yellow", markup=False)
    table = Table(title=f"{len(cloth.mesh.faces)} triangles", title_justify="left", box=box.SIMPLE_HEAD)
    for heading in ("field", "median", "5 %", "95 %", "unit"):
        table.add_column(heading, justify="left" if heading == "field" else "right")
    units = {name: str(cloth.material.get_submodule(name).unit) for name in fit.fields}
    for name, values in fit.fields.items():
        low, middle, high = values.quantile(values.new_tensor([0.05, 0.5, 0.95])).tolist()
        table.add_row(name, f"{middle:.3g}", f"{low:.3g}", f"{high:.3g}", units[name])
    console.print(table)
    before, after = (1e3 * fit.fit[f"chamfer_{key}"] for key in ("before", "after"))
    if not math.isnan(after):
        console.print(f"Chamfer, one-sided, cloud to surface: {before:.2f} mm before, {after:.2f} mm fitted")
    print(f"result:   {path}{note}\npicture:  {picture}")
    return 0
