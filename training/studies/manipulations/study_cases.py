"""What the three studies share on the command line, and the cases that they run or find."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

from torchcloth.errors import InvalidInput

from ...resumable import ResumableStudy
from .cases import Setup, solve
from .scenes import WORN, Manipulation, manipulations

QUICK = {"dress": 0, "trousers": 2, "shirt": 1}  # the legs of trousers always touch: the shortest action for them
FAST = Setup(triangles=130, gap=0.06, rate=10.0, points=120, iterations=2)


def add(parser: argparse.ArgumentParser) -> None:
    """Options."""
    option = parser.add_argument
    option(
        "--garments", nargs="+", choices=WORN, default=list(WORN), metavar="NAME", help=f"among {', '.join(WORN)} (all)"
    )
    option(
        "--count", type=int, metavar="N", help="manipulations of each garment (10; --fast: one, of another action each)"
    )
    option("--triangles", type=int, metavar="N", help="of each garment in the fit, about (150; the paper's: 1500)")
    option("--gap", type=float, metavar="M", help="between layers that touch [m] (0.05; a real one asks for 0.005)")
    option("--share", type=float, metavar="X", help="of the frames that are fitted, the early ones (0.5)")
    option("--report", action="store_true", help="only report on the cases that are finished")


def cases(options: argparse.Namespace) -> dict[str, dict[str, Any]]:
    """All cases by name: found in ``--out``, or computed and kept there.

    Raises:
        InvalidInput: numbers out of range, or nothing finished to report on.
    """
    setup, wanted = chosen(options)
    study = ResumableStudy(options.out, asdict(setup))
    if options.report:
        return finished(study, [what.name for what in wanted], options.out)
    return study.run({what.name: partial(solve, setup, what) for what in wanted})


def finished(study: ResumableStudy, names: Iterable[str], out: Path) -> dict[str, dict[str, Any]]:
    """Those of the cases that are there.

    Raises:
        InvalidInput: none is.
    """
    found = {name: case for name in names if (case := study.load_case(name)) is not None}
    if not found:
        raise InvalidInput("--report", got=f"no finished case in {out}", expected="at least one")
    return found


def chosen(options: argparse.Namespace) -> tuple[Setup, list[Manipulation]]:
    """Settings, and the manipulations, one of every garment after the other so that a part of them is of use."""
    setup, count = FAST if options.fast else Setup(), 10 if options.count is None else options.count
    changes = {key: getattr(options, key) for key in ("triangles", "gap", "share") if getattr(options, key) is not None}
    for key, value in {**changes, "count": count}.items():
        if not 0 < value < float("inf"):
            raise InvalidInput(f"--{key}", got=value, expected="a number > 0")
    setup = replace(setup, **changes)
    if setup.share > 1:
        raise InvalidInput("--share", got=setup.share, expected="a number in (0, 1]")
    if options.fast and options.count is None:  # an action each
        return setup, [manipulations(garment)[QUICK[garment]] for garment in options.garments]
    each = [manipulations(garment, count) for garment in options.garments]
    return setup, [what for row in zip(*each, strict=True) for what in row]
