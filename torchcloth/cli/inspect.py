"""``torchcloth inspect``: report what an episode contains and how far it can be trusted."""

from __future__ import annotations

import argparse
import json
from typing import Any

from .._utils.files import write_text
from .output_paths import check_output_folder, check_outside_episodes, output_path, replacement_note

INSPECTION_FILE_NAME = "inspection.json"


def add(verbs: Any) -> None:
    """Add the verb and its options."""
    inspect = verbs.add_parser(
        "inspect", help="report streams, rates, gaps, lag, noise and rejected frames of an episode"
    )
    inspect.add_argument("episode", metavar="EPISODE", help="folder of a recording")
    inspect.add_argument("--out", type=output_path, metavar="DIR", help="also write inspection.json and inspection.png")
    inspect.add_argument("--json", action="store_true", help="print inspection.json instead of tables")
    inspect.set_defaults(run=_inspect)


def _inspect(options: argparse.Namespace) -> int:
    from rich.console import Console
    from rich.markup import escape

    from .. import inspection, recordings

    if options.out is not None:
        check_outside_episodes(options.out, options.episode)
        check_output_folder(options.out)
    with Console(stderr=True).status(escape(f"inspecting {options.episode}")):
        report = inspection.inspect(recordings.read(options.episode))
    text = json.dumps(report.as_dict(), indent=1, allow_nan=False) + "\n"
    written = ""
    if options.out is not None:  # before printing, which fails if the reader closes the pipe
        note = replacement_note(options.out / INSPECTION_FILE_NAME)
        picture = inspection.draw(report, options.out)
        written = f"result:  {write_text(options.out / INSPECTION_FILE_NAME, text)}{note}\npicture: {picture}\n"
    if options.json:
        print(text, end="")
    else:
        inspection.show(report)
        print(written, end="")
    return 0
