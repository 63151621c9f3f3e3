"""``torchcloth diagnose``: what the simulation gets wrong in recorded episodes, and why."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from ..errors import InvalidInput


def add(verbs: Any) -> None:
    """The verb and its options."""
    parser = verbs.add_parser("diagnose", help="find what a simulation of recorded episodes gets wrong, and why")
    parser.add_argument("episodes", nargs="+", metavar="EPISODE", help="folders of one cloth's episodes")
    parser.add_argument("--model", metavar="MODEL", help="a .tcm file to start from (default: A-EP in vacuum)")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the result")
    parser.set_defaults(run=_diagnose)


def _diagnose(options: argparse.Namespace) -> int:
    import torch

    from .. import diagnosis, recordings

    torch.set_default_dtype(torch.float64)
    torch.set_num_threads(1)
    if options.out.exists() and not options.out.is_dir():
        raise InvalidInput("--out", got=f"{options.out}, a file", expected="a folder, new or existing")
    model = None if options.model is None else diagnosis.load_model(options.model)
    episodes = [recordings.read(path) for path in options.episodes]
    answer = diagnosis.diagnose(episodes, model, progress=_progress())
    path = diagnosis.write_diagnosis(answer, episodes[0], options.out)
    print(f"verdict: {answer.verdict}")
    print(answer.summary())
    print("\n".join(str(path.parent / name) for name in (path.name, "report.html", answer.content["model"])))
    return 0


def _progress():
    """One line that changes on a terminal; nothing in a log."""
    if not sys.stderr.isatty():
        return lambda _: None
    from rich.console import Console

    status = Console(stderr=True).status("")
    status.start()
    return lambda text: status.update(text)
