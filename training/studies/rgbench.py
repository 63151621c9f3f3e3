"""RGBench: measured garments that two arms fling, fold and grasp, simulated, beside the published means.

The data set is not shipped (6.7 GB, hwk0809/RGBench-Cloth-Sim2Real-v1 at Hugging Face): name its folder by --data, and
the folder ``configs`` of a clone of the benchmark's repository by --configs. Each capture is simulated with the fabric
that the benchmark states, or with one that is fitted to the first capture of its cell (--fit).
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from torchcloth.errors import InvalidInput

from ..resumable import ResumableStudy, write_result
from .manipulations.console_tables import heading_table, mm, show
from .rgbench_data import (
    PUBLISHED_MEANS_M,
    PUBLISHED_SIMULATORS,
    RGBENCH_ACTIONS,
    Capture,
    list_captures,
    select_captures,
)
from .rgbench_simulation import RgbenchSettings, fit_capture, simulate_capture

CAPTURES_PER_CELL, FAST_CAPTURES_PER_CELL = 3, 1
RGBENCH_FIT_ITERATIONS, FAST_FIT_ITERATIONS = 10, 1
DISTANCE_NAMES = ("vertices_l1", "surface")


def add(parser: argparse.ArgumentParser) -> None:
    """Add the study's options."""
    option = parser.add_argument
    option("--data", type=Path, required=True, metavar="FOLDER", help="folder of the data set")
    option("--configs", type=Path, metavar="FOLDER", help="configs of the benchmark's repository (DATA/configs)")
    option("--garments", nargs="+", metavar="NAME", help="some of the garments (all)")
    option("--actions", nargs="+", choices=RGBENCH_ACTIONS, default=list(RGBENCH_ACTIONS), help="some actions (all)")
    option("--captures", type=int, metavar="N", help=f"captures of each cell ({CAPTURES_PER_CELL})")
    option("--fit", action="store_true", help="fit the fabric to the first capture of each cell; predict the others")


def run(options: argparse.Namespace) -> None:
    """Simulate the missing captures, then print and write the table."""
    count = (
        (FAST_CAPTURES_PER_CELL if options.fast else CAPTURES_PER_CELL)
        if options.captures is None
        else options.captures
    )
    if count < 1:
        raise InvalidInput("--captures", got=count, expected="1 or more")
    configs = options.data / "configs" if options.configs is None else options.configs
    captures = select_captures(list_captures(options.data, configs), options.garments, options.actions, count)
    settings = RgbenchSettings(FAST_FIT_ITERATIONS if options.fast else RGBENCH_FIT_ITERATIONS, options.fast)
    places = {"data": str(options.data.resolve()), "configs": str(configs.resolve())}
    study = ResumableStudy(options.out, {"study": "rgbench", **places, "fast": options.fast})
    fits = _fit_fabrics(study, captures, options, configs, settings) if options.fit else {}
    fabric = "fitted" if options.fit else "nominal"
    cases = {
        f"{fabric}, {capture.name}": partial(
            simulate_capture, options.data, configs, capture, settings, fits[capture.cell]["values"] if fits else {}
        )
        for capture in captures
    }
    finished = list(study.run(cases).values())
    cells = summarise(captures, finished, fitted=options.fit)
    show(_table(cells, fabric), *_notes(captures, finished), *map(_describe_fit, fits, fits.values()))
    result = {
        "fabric": fabric,
        "cells": cells,
        "captures": dict(zip(cases, finished, strict=True)),
    }
    print(f"result: {write_result(options.out / f'rgbench_{fabric}.json', 'rgbench', result)}")


def _fit_fabrics(
    study: ResumableStudy,
    captures: Sequence[Capture],
    options: argparse.Namespace,
    configs: Path,
    settings: RgbenchSettings,
) -> dict[tuple[str, str], dict[str, Any]]:
    """Return the fit of each cell, to its first capture."""
    first = {capture.cell: capture for capture in reversed(captures)}
    cases = {
        f"fit, {capture.name}": partial(fit_capture, options.data, configs, capture, settings)
        for capture in first.values()
    }
    return dict(zip(first, study.run(cases).values(), strict=True))


def summarise(captures: Sequence[Capture], cases: Sequence[Mapping[str, Any]], *, fitted: bool) -> list[dict[str, Any]]:
    """Return the means [m] of each cell; a capture that was fitted counts only if the cell has no other.

    Args:
        captures: in the order of the cells.
        cases: one for each capture.
        fitted: whether the first capture of each cell was fitted.
    """
    cells: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for capture, case in zip(captures, cases, strict=True):
        cells.setdefault(capture.cell, []).append(case)
    rows = []
    for (garment, action), group in cells.items():
        is_predicted = fitted and len(group) > 1
        done = [case for case in group[1 if is_predicted else 0 :] if "failed" not in case]
        row: dict[str, Any] = {"garment": garment, "action": action, "captures": len(done), "predicted": is_predicted}
        for name in ("simulated", "carried") if done else ():
            row[name] = {key: float(np.mean([case[name][key] for case in done])) for key in done[0][name]}
        published = PUBLISHED_MEANS_M.get((garment, action))
        row["published"] = None if published is None else dict(zip(PUBLISHED_SIMULATORS, published, strict=True))
        rows.append(row)
    return rows


def _describe_fit(cell: tuple[str, str], fit: Mapping[str, Any]) -> str:
    """Return which values of a cell are fitted; the others are those that the benchmark states."""
    reason = f" ({fit['failed']})" if "failed" in fit else ""
    return f"{', '.join(cell)}: fitted {', '.join(fit['identified']) or 'nothing'}{reason}"


def _table(cells: Sequence[Mapping[str, Any]], fabric: str) -> Any:
    title = f"Mean distance [mm] of the clouds from the simulation ({fabric} fabric), over the window of each capture"
    heads = ("captures", "vertices, L1", "surface", "carried: L1", "surface", *(f"| {n}" for n in PUBLISHED_SIMULATORS))
    table = heading_table(title, "garment", "action", *heads)
    for cell in cells:
        ours = [
            cell[name][key] if name in cell else None for name in ("simulated", "carried") for key in DISTANCE_NAMES
        ]
        published = [(cell["published"] or {}).get(name) for name in PUBLISHED_SIMULATORS]
        table.add_row(cell["garment"], cell["action"], str(cell["captures"]), *map(mm, [*ours, *published]))
    both = [cell for cell in cells if cell["published"] and "simulated" in cell]
    if both:
        table.add_section()
        ours = [np.mean([c[name][key] for c in both]) for name in ("simulated", "carried") for key in DISTANCE_NAMES]
        published = [np.mean([c["published"][name] for c in both]) for name in PUBLISHED_SIMULATORS]
        captures = str(sum(cell["captures"] for cell in both))
        table.add_row(f"mean of {len(both)} cells", "", captures, *map(mm, map(float, [*ours, *published])))
    return table


def _notes(captures: Sequence[Capture], cases: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return notes on the distances, and the captures that failed."""
    means = ", ".join(f"{1e3 * mean:.1f}" for mean in np.mean(list(PUBLISHED_MEANS_M.values()), axis=0))
    notes = [
        "vertices, L1: the benchmark's metric, mean over the points of the least sum of coordinate differences to a "
        "vertex of the published mesh. It cannot fall below a share of the edge length. surface: Euclidean, to the "
        "triangles. carried: the first shape, moved rigidly with the grippers. The published means are those of the "
        f"benchmark's 'fixed point' protocol; over all {len(PUBLISHED_MEANS_M)} cells they are {means} mm."
    ]
    failed = [(c.name, case["failed"]) for c, case in zip(captures, cases, strict=True) if "failed" in case]
    return [*notes, *(f"{name} failed: {reason}" for name, reason in failed)]
