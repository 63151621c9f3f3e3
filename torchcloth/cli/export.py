"""``torchcloth export``: write an identified cloth for another simulator."""

from __future__ import annotations

import argparse
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .output_paths import check_output_file, check_outside_episodes, output_path, replacement_note

if TYPE_CHECKING:
    from ..export import Export

TARGETS = ("mujoco", "newton", "usd")
LINE_WIDTH = 110


def add(verbs: Any) -> None:
    """Add the verb and its options."""
    parser = verbs.add_parser(
        "export",
        help="write an identified cloth for MuJoCo, Newton or USD",
        description="Write mesh, masses, moduli, bending, damping and drag of a fit in the target's own parameters and "
        "units. What the target cannot express is printed, and stands in the file.",
    )
    add = parser.add_argument
    add(
        "fit",
        type=Path,
        metavar="FIT",
        help="identification.json, the folder that holds it, or a .tcm file of `diagnose`",
    )
    add(
        "episode",
        type=Path,
        nargs="?",
        metavar="EPISODE",
        help="an episode of the cloth, which has the mesh and its first shape; a .tcm file needs none",
    )
    add("--to", choices=TARGETS, required=True, help="MJCF (.xml), JSON for Newton, or a USD layer (.usda)")
    add("--out", type=output_path, required=True, metavar="FILE", help="file to write; an earlier one is replaced")
    parser.set_defaults(run=_export)


def _export(options: argparse.Namespace) -> int:
    import torch

    from .. import recordings
    from ..export import export_fit

    torch.set_default_dtype(torch.float64)
    torch.set_num_threads(1)
    recording = None
    if options.episode is not None:
        check_outside_episodes(options.out, options.episode)
        recording = recordings.read(options.episode)
    check_output_file(options.out)
    note = replacement_note(options.out)
    export = export_fit(options.fit, options.to, options.out, recording=recording)
    _print(export)
    print(f"result: {options.out}{note}")
    return 0


def _print(export: Export) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(title=f"The cloth in {export.target}'s parameters", title_justify="left")
    for heading in ("parameter", "value", "unit", "meaning"):
        table.add_column(heading, justify="right" if heading == "value" else "left", no_wrap=heading != "meaning")
    for parameter in export.parameters:
        table.add_row(parameter.name, f"{parameter.value:.5g}", parameter.unit, parameter.meaning)
    Console().print(table)
    print(f"What is not known, and what {export.target} does not express, or only in part:")
    for sentence in export.notes:
        print(textwrap.fill(sentence, LINE_WIDTH, initial_indent="- ", subsequent_indent="  "))
