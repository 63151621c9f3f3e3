"""What a fit costs, beside plain gradient descent on the same problem."""

from __future__ import annotations

import argparse
import time
from dataclasses import asdict
from functools import partial
from typing import Any

from torchcloth.errors import InvalidInput
from torchcloth.identification import identify

from ...kept import Kept
from . import options
from .cases import SOUGHT, Setup, seen
from .printing import heading_table, mm, number, show, write
from .scenes import Fabric, manipulations

DRAG = 2  # the number of a manipulation without folds
METHODS = ("gauss-newton", "gradient-descent")
PROMISED = 15.0  # min, for 1500 triangles and 3 s


def add(parser: argparse.ArgumentParser) -> None:
    """Options."""
    option = parser.add_argument
    option("--cost", action="store_true", help="instead: what one fit costs, beside plain gradient descent")
    option("--descent", type=int, default=10, metavar="N", help="steps of gradient descent (10; the paper's: 35)")


def run(chosen: argparse.Namespace) -> None:
    """Both searches on one manipulation of each garment, all its frames."""
    if chosen.descent < 1:
        raise InvalidInput("--descent", got=chosen.descent, expected="1 or more")
    setup, wanted = options.chosen(chosen)
    folder = chosen.out / "cost"
    kept = Kept(folder, {**asdict(setup), "descent": chosen.descent})
    garments = list(dict.fromkeys(what.garment for what in wanted))
    cases = {
        f"{garment}-{method}": partial(_measure, setup, garment, method, chosen.descent)
        for garment in garments
        for method in METHODS
    }
    found = kept.run(cases)
    show(_table(found), NOTE)
    write(chosen.out / "cost.json", {"cases": found, "promised_minutes": PROMISED})


def _measure(setup: Setup, garment: str, method: Any, steps: int) -> dict[str, Any]:
    """Seconds on the clock and of the processor, simulations, distances and values of one search."""
    model, data = seen(setup, manipulations(garment)[DRAG])
    true = Fabric.true(garment)
    iterations = setup.iterations if method == METHODS[0] else steps
    begun, used = time.perf_counter(), time.process_time()
    fit = identify(model.cloth(true.start()), data.recording, list(SOUGHT), method=method, iterations=iterations)
    return {
        "garment": garment,
        "method": method,
        "triangles": len(model.mesh.faces),
        "length": float(data.recording.require("points").t[-1]),
        "seconds": time.perf_counter() - begun,
        "processor": time.process_time() - used,
        "values": {name: fit.parameters[name].value / true.named()[name] for name in SOUGHT},
        **{key: fit.fit[key] for key in ("simulations", "iterations", "converged", "chamfer_before", "chamfer_after")},
    }


def _table(found: dict[str, dict[str, Any]]):
    table = heading_table(
        "Cost of a fit of E, nu, k and gamma to all frames of a drag", "garment", "method", "triangles", "motion",
        "iterations", "simulations", "clock", "processor", "Chamfer [mm]", "E / truth",
    )  # fmt: skip
    for row in found.values():
        end = "" if row["converged"] else " *"
        table.add_row(
            row["garment"],
            row["method"],
            str(row["triangles"]),
            f"{row['length']:.2f} s",
            f"{row['iterations']:.0f}{end}",
            f"{row['simulations']:.0f}",
            f"{row['seconds']:.0f} s",
            f"{row['processor']:.0f} s",
            f"{mm(row['chamfer_before'])} > {mm(row['chamfer_after'])}",
            number(row["values"]["youngs_modulus"], 3),
        )
    return table


NOTE = (
    "*: stopped there, not converged. Distances: Chamfer, one-sided, cloud to surface. Clock: with whatever else ran; "
    "processor: of this process alone. Gauss-Newton counts each of its tangents as a simulation, and ends with error "
    "bars; gradient descent follows the paper's loss (cloud to nearest vertex), in logarithms, and has no test of "
    "convergence."
)
