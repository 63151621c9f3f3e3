"""One fit to several manipulations of a garment that is held at the same places."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from typing import Any

from ...resumable import ResumableStudy
from . import study_cases
from .cases import SOUGHT, solve_together
from .console_tables import heading_table, number, show, write
from .scenes import GRIPS, Manipulation

CALM = ("cover", "drag")  # a fling's slopes are of no use, alone or beside others


def add(parser: argparse.ArgumentParser) -> None:
    """Options."""
    text = f"instead: all {' and '.join(CALM)} cases that are held {next(iter(GRIPS))}, each garment's in one fit"
    parser.add_argument("--joint", action="store_true", help=text)


def run(chosen: argparse.Namespace) -> None:
    """Fits, table and result."""
    setup, wanted = study_cases.chosen(chosen)
    study = ResumableStudy(chosen.out, asdict(setup))
    cases = {_name(garment, own): partial(solve_together, setup, own) for garment, own in alike(wanted).items()}
    found = study_cases.finished(study, cases, chosen.out) if chosen.report else study.run(cases)
    show(_table(found))
    write(chosen.out / "joint.json", found)


def _name(garment: str, own: Sequence[Manipulation]) -> str:
    """Of a fit to these: others are another fit."""
    return f"{garment}-joint-" + "-".join(f"{what.number:02d}" for what in own)


def alike(wanted: list[Manipulation]) -> dict[str, list[Manipulation]]:
    """By garment what is fitted together: a cloth has one set of grips."""
    out: dict[str, list[Manipulation]] = {}
    for what in wanted:
        if what.action in CALM and what.grip == next(iter(GRIPS)):
            out.setdefault(what.garment, []).append(what)
    return out


def _table(found: dict[str, dict[str, Any]]):
    table = heading_table(
        "Several manipulations in one fit", "garment", "parameter", "over truth", "std. error", "95 % interval", "of"
    )
    for case in found.values():
        count, garment = len(case["manipulations"]), case["manipulations"][0]["garment"]
        for name in SOUGHT:
            e = case.get("found", {}).get(name, {"identifiable": False})
            cells = ["not identifiable", "", ""]
            if e["identifiable"]:
                value, std, low, high = (v / case["truth"][name] for v in (e["value"], e["std"], *e["ci95"]))
                cells = [number(value, 3), number(std, 2), f"{low:.2f} … {high:.2f}"]
            table.add_row(garment, name, *cells, f"{count} episodes", end_section=name == SOUGHT[-1])
    return table
