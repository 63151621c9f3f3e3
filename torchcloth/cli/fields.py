"""``torchcloth identify --fields``: one value per triangle instead of one for the cloth."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .._utils.files import PROGRESS
from ..errors import InvalidInput
from .folders import replaces

if TYPE_CHECKING:
    from ..cloth import Cloth
    from ..identification.fields import FieldFit
    from ..recordings import Recording

SINGLE = ("fit", "starts", "profile", "nuisance", "prior", "refine", "method", "stop")  # options of single values only


def add(parser: argparse.ArgumentParser) -> None:
    """Options."""
    parser.add_argument(
        "--fields",
        nargs="+",
        metavar="NAME",
        help="instead: one value per triangle of these parameters of the material, smooth, without errors",
    )
    parser.add_argument(
        "--contrast", type=float, metavar="X", help="how much a field may vary: a factor of e^X from side to side (1)"
    )


def check(options: argparse.Namespace, defaults: argparse.Namespace) -> None:
    """Refuse options that fields do not have, and the other way round.

    Raises:
        InvalidInput: such an option.
    """
    if options.fields is None:
        if options.contrast is not None:
            raise InvalidInput("--contrast", got=options.contrast, expected="--fields beside it")
        return
    for name in SINGLE:
        if getattr(options, name) != getattr(defaults, name):
            raise InvalidInput(f"--{name}", got="a value, with --fields", expected="one of them")


def spread_out(cloth: Cloth, names: list[str]) -> None:
    """Give parameters of the material one value per triangle, equal at first.

    Raises:
        InvalidInput: no such parameter.
    """
    from ..parameters import PhysicalParameter

    known = {name: p for name, p in cloth.material.named_modules() if isinstance(p, PhysicalParameter)}
    known = {name: p for name, p in known.items() if p.domain != "nonnegative"}
    for name in names:
        if name not in known:
            raise InvalidInput("--fields", got=repr(name), expected=f"one of {', '.join(sorted(known))}")
        known[name].raw.data = known[name].raw.detach().expand(len(cloth.mesh.faces)).clone()


def fit(options: argparse.Namespace, cloth: Cloth, episodes: list[Recording], journal: Path, advance: Any) -> FieldFit:
    """The search."""
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


def report(folder: Path, found: FieldFit, cloth: Cloth) -> int:
    """A table, fields.json and fields.png."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    from .._utils.resume import clear
    from ..identification.fields import RESULT
    from ..identification.pictures import field_maps, save_figure

    note = replaces(folder / RESULT)
    path = found.save(folder)
    picture = save_figure(field_maps(found.fields, cloth), folder / "fields.png")
    clear(folder / PROGRESS)  # before anything is printed, to somebody who may stop reading
    table = Table(title=f"{len(cloth.mesh.faces)} triangles", title_justify="left", box=box.SIMPLE_HEAD)
    for heading in ("field", "median", "5 %", "95 %", "unit"):
        table.add_column(heading, justify="left" if heading == "field" else "right")
    units = {name: str(cloth.material.get_submodule(name).unit) for name in found.fields}
    for name, values in found.fields.items():
        low, middle, high = values.quantile(values.new_tensor([0.05, 0.5, 0.95])).tolist()
        table.add_row(name, f"{middle:.3g}", f"{low:.3g}", f"{high:.3g}", units[name])
    console = Console(highlight=False)
    console.print(table)
    before, after = (1e3 * found.fit[f"chamfer_{key}"] for key in ("before", "after"))
    if not math.isnan(after):
        console.print(f"Chamfer, one-sided, cloud to surface: {before:.2f} mm before, {after:.2f} mm fitted")
    for warning in found.warnings:
        console.print(f"note: {warning}", style="yellow", markup=False)
    print(f"result:   {path}{note}\npicture:  {picture}")
    return 0
