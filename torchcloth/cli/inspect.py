"""``torchcloth inspect``: what an episode holds, and how far it can be trusted."""

from __future__ import annotations

import argparse
import json
from typing import Any

from .._utils.files import write_text
from .folders import check_apart, check_folder, place, replaces

RESULT = "inspection.json"


def add(verbs: Any) -> None:
    """The verb."""
    inspect = verbs.add_parser("inspect", help="streams, rates, gaps, lag, noise, rejected frames of an episode")
    inspect.add_argument("episode", metavar="EPISODE", help="folder of a recording")
    inspect.add_argument("--out", type=place, metavar="DIR", help="also write inspection.json and inspection.png")
    inspect.add_argument("--json", action="store_true", help="print inspection.json instead of tables")
    inspect.set_defaults(run=_inspect)


def _inspect(options: argparse.Namespace) -> int:
    from rich.console import Console
    from rich.markup import escape

    from .. import inspection, recordings

    if options.out is not None:
        check_apart(options.out, options.episode)
        check_folder(options.out)
    with Console(stderr=True).status(escape(f"looking at {options.episode}")):
        report = inspection.inspect(recordings.read(options.episode))
    text = json.dumps(report.as_dict(), indent=1, allow_nan=False) + "\n"
    written = ""
    if options.out is not None:  # before anything is printed: who reads may stop
        note = replaces(options.out / RESULT)
        picture = inspection.draw(report, options.out)
        written = f"result:  {write_text(options.out / RESULT, text)}{note}\npicture: {picture}\n"
    if options.json:
        print(text, end="")
    else:
        inspection.show(report)
        print(written, end="")
    return 0
