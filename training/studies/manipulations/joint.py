"""Joint fits to several manipulations of a garment with the same grips."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from typing import Any

from ...resumable import ResumableStudy, write_result
from . import study_cases
from .cases import PAPER_PARAMETERS, solve_together
from .console_tables import heading_table, number, show
from .scenes import GRIPS, Manipulation

CALM_ACTIONS = ("cover", "drag")  # the slopes of a fling are useless, alone or with others


def add(parser: argparse.ArgumentParser) -> None:
    """Add the option ``--joint``."""
    text = f"fit all {' and '.join(CALM_ACTIONS)} cases of a garment, gripped {next(iter(GRIPS))}, together"
    parser.add_argument("--joint", action="store_true", help=text)


def run(options: argparse.Namespace) -> None:
    """Compute the missing fits, print the table and write joint.json."""
    setup, wanted = study_cases.choose(options)
    study = ResumableStudy(options.out, asdict(setup))
    cases = {
        _name(garment, group): partial(solve_together, setup, group)
        for garment, group in group_by_garment(wanted).items()
    }
    cases = study_cases.load_finished(study, cases, options.out) if options.report else study.run(cases)
    show(_table(cases))
    write_result(options.out / "joint.json", "garments_joint", cases)


def _name(garment: str, group: Sequence[Manipulation]) -> str:
    """Return the name of a joint fit, which contains the numbers of its cases."""
    return f"{garment}-joint-" + "-".join(f"{what.number:02d}" for what in group)


def group_by_garment(wanted: list[Manipulation]) -> dict[str, list[Manipulation]]:
    """Return the cases that are fitted together by garment; a cloth has one set of grips."""
    out: dict[str, list[Manipulation]] = {}
    for what in wanted:
        if what.action in CALM_ACTIONS and what.grip == next(iter(GRIPS)):
            out.setdefault(what.garment, []).append(what)
    return out


def _table(cases: dict[str, dict[str, Any]]):
    table = heading_table(
        "Several manipulations in one fit", "garment", "parameter", "over truth", "std. error", "95 % interval", "of"
    )
    for case in cases.values():
        count, garment = len(case["manipulations"]), case["manipulations"][0]["garment"]
        for name in PAPER_PARAMETERS:
            e = case.get("estimates", {}).get(name, {"identifiable": False})
            cells = ["not identifiable", "", ""]
            if e["identifiable"]:
                value, std, low, high = (v / case["truth"][name] for v in (e["value"], e["std"], *e["ci95"]))
                cells = [number(value, 3), number(std, 2), f"{low:.2f} … {high:.2f}"]
            table.add_row(garment, name, *cells, f"{count} episodes", end_section=name == PAPER_PARAMETERS[-1])
    return table
