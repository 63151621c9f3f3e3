"""``python -m torchcloth.training.studies NAME --out DIR``: one module a study, each with ``add`` and ``run``."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

from ..resumable import run_study_command

# Modules of this package; ``add(parser)`` declares options, ``run(options)`` does it.
STUDIES: tuple[str, ...] = (
    "fabrics",
    "garments",
    "chamfer",
    "factors",
    "classify",
    "measured",
    "pose",
    "cost",
    "reach",
    "trajectories",
    "hidden",
    "parts",
    "salting",
    "air",
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code (0 done, 2 wrong input, 130 interrupted)."""
    options = _parser().parse_args(arguments)
    study = import_module(f".{options.study}", __package__)
    return run_study_command("studies", "finished cases", lambda: study.run(options))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m torchcloth.training.studies", description=__doc__)
    studies = parser.add_subparsers(dest="study", required=True, metavar="NAME")
    for name in STUDIES:
        module = import_module(f".{name}", __package__)
        said = (module.__doc__ or "").partition("\n")[0]
        own = studies.add_parser(name, help=said, description=module.__doc__)
        own.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for cases, tables and pictures")
        own.add_argument("--fast", action="store_true", help="a reduced version: a minute or two")
        module.add(own)
    return parser
