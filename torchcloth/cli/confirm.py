"""``torchcloth confirm``: what an extended model gains on episodes that it was not fitted to."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .._utils.files import as_json, write_text
from .diagnose import progress_line
from .folders import check_apart, check_folder, place, replaces

if TYPE_CHECKING:
    from ..diagnosis import Gain


def add(verbs: Any) -> None:
    """The verb and its options."""
    parser = verbs.add_parser(
        "confirm",
        help="what an extended model gains on episodes never seen",
        description="Simulates each episode with both models, as they are, and compares how far they are from what "
        "was seen. Episodes that a model was fitted to are refused.",
    )
    parser.add_argument("base", type=Path, metavar="BASE", help="a .tcm file, e.g. DIR/base.tcm of `diagnose`")
    parser.add_argument("extended", type=Path, metavar="EXTENDED", help="a .tcm file, e.g. DIR/extended.tcm")
    parser.add_argument("episodes", nargs="+", metavar="EPISODE", help="folders of the same cloth's episodes")
    parser.add_argument(
        "--out",
        type=place,
        metavar="DIR",
        help="folder for the result, which replaces the last (EXTENDED's folder/confirmation)",
    )
    parser.set_defaults(run=_confirm)


def _confirm(options: argparse.Namespace) -> int:
    import torch

    from .. import diagnosis, recordings
    from ..diagnosis.run import CONFIRMED

    torch.set_default_dtype(torch.float64)
    torch.set_num_threads(1)
    out = options.extended.parent / CONFIRMED.parent if options.out is None else options.out
    check_apart(out, *options.episodes)
    check_folder(out)
    episodes = [recordings.read(path) for path in options.episodes]
    with progress_line() as progress:
        found = diagnosis.confirm(options.base, options.extended, episodes, progress)
    note = replaces(out / CONFIRMED.name)
    path = write_text(out / CONFIRMED.name, as_json(found.as_dict()))
    _print(found)
    print(f"result: {path}{note}")
    return 0


def _print(found: Any) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    table = Table(title="Episodes that neither model has seen", title_justify="left")
    for head in ("motion", "base, mm", "extended, mm", "explained", "log density"):
        table.add_column(head, justify="left" if head == "motion" else "right")
    for name, gain in found.motions.items():
        table.add_row(escape(name), *_cells(gain))
    table.add_section()
    table.add_row("all", *_cells(found.whole))
    console = Console()
    console.print(table)
    word = "The gain is confirmed" if found.confirmed else "No gain is confirmed: not both of its intervals are above 0"
    console.print(f"{word}. A true model would leave {1e3 * found.floor:.2f} mm ({found.source}).")


def _cells(gain: Gain) -> list[str]:
    low, high = gain.explained_ci95
    share, density = f"{100 * gain.explained:.0f} %", f"{gain.density:+.0f}"
    if gain.least > -math.inf:  # else nothing is known of how it scatters
        share += f" ({100 * low:.0f} to {100 * high:.0f})"
        density += f" ({gain.ci95[0]:+.0f} to {gain.ci95[1]:+.0f})"
    if math.isnan(gain.before):  # forces only
        return ["–", "–", "–", density]
    return [f"{1e3 * gain.before:.2f}", f"{1e3 * gain.after:.2f}", share, density]
