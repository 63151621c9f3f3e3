"""What a fit costs, beside plain gradient descent on the same problem: a sheet of 800 triangles, a shirt of 1500."""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

from torchcloth.episodes.unknowns import find_scalar_parameters
from torchcloth.errors import InvalidInput
from torchcloth.identification import identify

from ..resumable import ResumableStudy
from . import stretching
from .manipulations import cases
from .manipulations.console_tables import heading_table, mm, number, show, write
from .manipulations.scenes import Discretisation, Fabric, Manipulation, manipulations, slowed

if TYPE_CHECKING:
    from torchcloth import Cloth
    from torchcloth.recordings import Recording

DRAG = 2  # the number of a manipulation without folds
SHEET = stretching.Fabric(60.0, 0.3, 0.25)  # N/m, -, kg/m^2
OFF = {"youngs_modulus": 2.5, "poisson_ratio": 2 / 3, "bending.stiffness": 1.5, "air.normal": 0.8}  # of the start
METHODS: dict[str, dict[str, Any]] = {
    "gauss-newton": {"method": "gauss-newton"},
    "descent": {"method": "gradient-descent"},
    "paper": {"method": "adam", "stop": "paper"},
}
PROMISED = {"sheet": 1.5, "shirt": 15.0}  # min, on two free cores


@dataclass(frozen=True)
class Scale:
    """How large the two problems are.

    Attributes:
        cell: m, of the sheet's mesh; the truth's are half of it.
        frames: of the sheet, 30 a second.
        triangles: of the shirt in the fit, about; the truth's has half as many again.
        gap: m between the shirt's layers; by default those of its mesh would rest 1.4 edges apart, 35 mm.
        length: s, of the shirt's drag over a table; None: as fast as in the other studies, about 1 s.
        rate: frames per second of the shirt.
        sheet_iterations: of Gauss-Newton on all frames, at most; by default that of ``identify``.
        shirt_iterations: likewise, of the shirt; by default that of the other studies of garments.
        descent: steps of gradient descent and Adam, at most.
    """

    cell: float = 0.01225
    frames: int = 30
    triangles: int = 1500
    gap: float = 0.035
    length: float | None = 3.0
    rate: float = 10.0
    sheet_iterations: int = 35
    shirt_iterations: int = 5
    descent: int = 10


FAST = Scale(
    cell=0.05,
    frames=8,
    triangles=130,
    gap=0.06,
    length=None,
    rate=8.0,
    sheet_iterations=2,
    shirt_iterations=2,
    descent=2,
)


class Problem(NamedTuple):
    """What all methods are given; descent and Adam look at its clouds alone."""

    cloth: Cloth  # at the start values
    recording: Recording
    names: list[str]
    truth: dict[str, float]
    iterations: int


def add(parser: argparse.ArgumentParser) -> None:
    """Options."""
    option = parser.add_argument
    known = list(PROMISED)
    option("--problems", nargs="+", choices=known, default=known, metavar="NAME", help="sheet, shirt (both)")
    option("--triangles", type=int, metavar="N", help="of the shirt in the fit, about (1500)")
    option("--gap", type=float, metavar="M", help="between the shirt's layers [m] (0.035)")
    option("--length", type=float, metavar="SECONDS", help="of the shirt's motion (3)")
    option("--descent", type=int, metavar="N", help="steps of gradient descent and of Adam (10; the paper's: 35)")


def run(chosen: argparse.Namespace) -> None:
    """Every method on every problem."""
    scale = FAST if chosen.fast else Scale()
    changes = {key: v for key in ("triangles", "gap", "length", "descent") if (v := getattr(chosen, key)) is not None}
    for key, value in changes.items():
        if not 0 < value < float("inf"):
            raise InvalidInput(f"--{key}", got=value, expected="a number > 0")
    scale = replace(scale, **changes)
    makers: dict[str, Callable[[Scale], Problem]] = {"sheet": sheet, "shirt": shirt}
    study = ResumableStudy(chosen.out, asdict(scale))
    found = study.run(
        {
            f"{problem}-{method}": partial(_measure, makers[problem], scale, problem, method)
            for problem in chosen.problems
            for method in METHODS
        }
    )
    show(_table(found), NOTE)
    write(chosen.out / "cost.json", {"cases": found, "promised_minutes": PROMISED})


def sheet(scale: Scale) -> Problem:
    """Pulled by two clamps for a second: E, nu, bending and drag from clouds, markers and forces.

    Where the clamps hold is known to half a millimetre only, which no method is told.
    """
    detail = stretching.Detail(scale.cell, scale.frames)
    recording = stretching.record(SHEET, stretching.Pull("x"), 5, detail)
    cloth = stretching.sheet(recording, SHEET)
    names = find_scalar_parameters(cloth)
    parameters: dict[str, Any] = {name: cloth.get_submodule(names[name]) for name in OFF}
    truth = {name: float(p.value.detach()) for name, p in parameters.items()}
    for name, off in OFF.items():
        parameters[name].set(off * truth[name])
    return Problem(cloth, recording, list(OFF), truth, scale.sheet_iterations)


def shirt(scale: Scale) -> Problem:
    """Dragged over a table: E, nu, k and gamma from clouds of a part of it."""
    setup = cases.Setup(scale.triangles, scale.gap, scale.rate)
    what: Manipulation = manipulations("shirt")[DRAG]
    if scale.length is not None:
        what = slowed(what, scale.length, Discretisation(scale.triangles, scale.gap))
    model, data = cases.seen(setup, what)
    true = Fabric.true("shirt")
    return Problem(model.cloth(true.start()), data.recording, list(cases.SOUGHT), true.named(), scale.shirt_iterations)


def _measure(make: Callable[[Scale], Problem], scale: Scale, name: str, method: str) -> dict[str, Any]:
    """Seconds on the clock and of the processor, simulations, distances and values of one search."""
    p, options = make(scale), METHODS[method]
    count = p.iterations if options["method"] == "gauss-newton" else scale.descent
    begun, used = time.perf_counter(), time.process_time()
    fit = identify(p.cloth, p.recording, p.names, iterations=count, **options)
    keys = ("simulations", "iterations", "converged", "chamfer_before", "chamfer_after")
    e = fit.parameters["youngs_modulus"]
    return {
        "problem": name,
        "method": method,
        "triangles": len(p.cloth.mesh.faces),
        "length": float(p.recording.require("points").t[-1]),
        "frames": len(p.recording.require("points")),
        "seconds": time.perf_counter() - begun,
        "processor": time.process_time() - used,
        "load": os.getloadavg()[1],
        "early": sum(entry["frames"] < 1 for entry in fit.history),
        "youngs_modulus": e.value / p.truth["youngs_modulus"],
        "identifiable": e.identifiable,
        "warnings": fit.warnings,
        **{key: fit.fit[key] for key in keys},
    }


def _table(found: dict[str, dict[str, Any]]):
    table = heading_table(
        "Cost of a fit of four parameters", "problem", "method", "triangles", "frames", "iterations", "simulations",
        "CPU", "clock", "load", "Chamfer [mm]", "E / truth",
    )  # fmt: skip
    for row in found.values():
        table.add_row(
            row["problem"],
            row["method"],
            str(row["triangles"]),
            f"{row['frames']} in {row['length']:.1f} s",
            f"{row['iterations']:.0f}{'' if row['converged'] else ' *'}",
            f"{row['simulations']:.0f}",
            f"{row['processor']:.0f} s",
            f"{row['seconds']:.0f} s",
            f"{row['load']:.1f}",
            f"{mm(row['chamfer_before'])} > {mm(row['chamfer_after'])}",
            number(row["youngs_modulus"], 3) + ("" if row["identifiable"] else " ?"),
        )
    return table


NOTE = (
    "descent: plain gradient descent; paper: Adam with the paper's stop, that loss below 15 mm. Both follow "
    "the paper's loss (cloud to nearest vertex), in logarithms, without markers and forces, which Gauss-Newton uses, "
    "and have no test of convergence. *: stopped there, not converged. "
    "?: called not identifiable. Iterations: of all stages. CPU: of the fit alone; clock: with what "
    "else ran; load: processes that wanted to run, mean of 5 minutes. Chamfer: one-sided, cloud to surface, at start "
    "and end. Gauss-Newton counts each of its tangents as a simulation, and ends with error bars."
)
