"""Options of the three studies, and the cases that they load or compute."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

from torchcloth.errors import InvalidInput

from ...resumable import ResumableStudy
from .cases import Setup, solve_case
from .scenes import STUDY_GARMENTS, Manipulation, manipulations

FAST_NUMBER = {
    "dress": 0,
    "trousers": 2,
    "shirt": 1,
}  # trousers get the shortest action, because their legs always touch
FAST_SETUP = Setup(triangles=130, gap=0.06, rate=10.0, points=120, iterations=2)


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options that the three studies share."""
    option = parser.add_argument
    option(
        "--garments",
        nargs="+",
        choices=STUDY_GARMENTS,
        default=list(STUDY_GARMENTS),
        metavar="NAME",
        help=f"one or more of {', '.join(STUDY_GARMENTS)} (default: all)",
    )
    option(
        "--count",
        type=int,
        metavar="N",
        help="manipulations of each garment (default: 10; with --fast one, each of another action)",
    )
    option("--triangles", type=int, metavar="N", help="approximate number in the fit (default: 150; the paper: 1500)")
    option(
        "--gap", type=float, metavar="M", help="distance of layers that touch [m] (default: 0.05; a real one: 0.005)"
    )
    option("--share", type=float, metavar="X", help="fraction of early frames that are fitted (default: 0.5)")
    option("--report", action="store_true", help="only report on finished cases")


def load_or_compute(options: argparse.Namespace) -> dict[str, dict[str, Any]]:
    """Return all cases by name, loaded from ``--out`` or computed and saved there.

    Raises:
        InvalidInput: a number is out of range, or no case is finished to report on.
    """
    setup, wanted = choose(options)
    study = ResumableStudy(options.out, asdict(setup))
    if options.report:
        return load_finished(study, [what.name for what in wanted], options.out)
    return study.run({what.name: partial(solve_case, setup, what) for what in wanted})


def load_finished(study: ResumableStudy, names: Iterable[str], out: Path) -> dict[str, dict[str, Any]]:
    """Return the finished cases.

    Raises:
        InvalidInput: no case is finished.
    """
    results = {name: case for name in names if (case := study.load_case(name)) is not None}
    if not results:
        raise InvalidInput("--report", got=f"no finished case in {out}", expected="at least one")
    return results


def choose(options: argparse.Namespace) -> tuple[Setup, list[Manipulation]]:
    """Return settings and manipulations, alternating between garments so that a partial study is useful."""
    setup, count = FAST_SETUP if options.fast else Setup(), 10 if options.count is None else options.count
    changes = {key: getattr(options, key) for key in ("triangles", "gap", "share") if getattr(options, key) is not None}
    for key, value in {**changes, "count": count}.items():
        if not 0 < value < float("inf"):
            raise InvalidInput(f"--{key}", got=value, expected="a number > 0")
    setup = replace(setup, **changes)
    if setup.share > 1:
        raise InvalidInput("--share", got=setup.share, expected="a number in (0, 1]")
    if options.fast and options.count is None:  # another action for each garment
        return setup, [manipulations(garment)[FAST_NUMBER[garment]] for garment in options.garments]
    each = [manipulations(garment, count) for garment in options.garments]
    return setup, [what for row in zip(*each, strict=True) for what in row]
