"""Command ``python -m torchcloth.training.studies NAME --out DIR``.

Each study is a module of this package. ``add(parser)`` declares its options, ``run(options)`` runs it.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

from ..resumable import run_study_command

STUDY_NAMES: tuple[str, ...] = (
    "fabrics",
    "garments",
    "chamfer",
    "factors",
    "classify",
    "measured",
    "pose",
    "pose_garments",
    "pose_network",
    "cost",
    "reach",
    "trajectories",
    "hidden",
    "screening",
    "fault_injection",
    "honesty",
    "strangers",
    "air",
    "camera",
    "rgbench",
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit code (0 done, 2 wrong input, 130 interrupted)."""
    options = _parser().parse_args(arguments)
    study = import_module(f".{options.study}", __package__)
    return run_study_command("studies", "finished cases", lambda: study.run(options))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m torchcloth.training.studies", description=__doc__)
    studies = parser.add_subparsers(dest="study", required=True, metavar="NAME")
    for name in STUDY_NAMES:
        module = import_module(f".{name}", __package__)
        summary = (module.__doc__ or "").partition("\n")[0]
        subparser = studies.add_parser(name, help=summary, description=module.__doc__)
        subparser.add_argument(
            "--out", type=Path, required=True, metavar="DIR", help="folder for cases, tables and pictures"
        )
        subparser.add_argument("--fast", action="store_true", help="run a reduced version, which takes a minute or two")
        module.add(subparser)
    return parser
