"""The command ``python -m torchcloth.training.validation.fuzz``."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import torch

from torchcloth.errors import InvalidInput, TorchclothError

from . import targets
from .coverage import Search
from .formats import FORMATS

SEEDS_FOLDER = Path("tests/validation/fuzz/seeds")  # of the repository, one folder for each format
DEFAULT_INPUTS = 1_000_000


def main(argv: list[str] | None = None) -> int:
    """Run the command, and return its exit code where nothing was searched: 2, wrong input.

    A search ends the process itself: 0 without faults, 1 with some.
    """
    options = _parser().parse_args(argv)
    fuzzed = FORMATS[options.format]
    seeds = options.seeds / options.format
    corpus = options.corpus or targets.scratch_folder() / "corpus"
    torch.set_num_threads(1)
    torch.set_default_dtype(torch.float64)
    try:
        if not seeds.is_dir():
            remedy = "run it at the root of the repository, or pass --seeds"
            raise InvalidInput("--seeds", got=f"no folder {seeds}", expected="a folder for each format", remedy=remedy)
        if not (options.inputs > 0 and options.seconds > 0):
            raise InvalidInput("--inputs, --seconds", got=f"{options.inputs}, {options.seconds}", expected="above 0")
        Search(fuzzed, corpus, [seeds], options.inputs, options.seconds).run()
    except (TorchclothError, OSError) as error:
        print(f"fuzz: {error}", file=sys.stderr)
        return 2


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m torchcloth.training.validation.fuzz",
        description="Search for inputs that make a reader raise anything but TorchclothError, or accept what breaks "
        "the invariants of its format. Inputs that do are written into CORPUS/faults. Exit code: 0 no faults, "
        "1 faults, 2 wrong input.",
    )
    parser.add_argument("format", choices=sorted(FORMATS), help="format of the files")
    parser.add_argument("--inputs", type=int, default=DEFAULT_INPUTS, metavar="N", help="end after so many inputs")
    parser.add_argument("--seconds", type=float, default=float("inf"), metavar="S", help="end after so many seconds")
    parser.add_argument("--corpus", type=Path, metavar="DIR", help="where inputs that reach new branches are collected")
    parser.add_argument(
        "--seeds", type=Path, default=SEEDS_FOLDER, metavar="DIR", help="folders of seeds, by format (%(default)s)"
    )
    return parser
