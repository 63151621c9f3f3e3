"""Times of each path through the engine: ``python -m torchcloth.benchmarks.paths``.

The same cloth and motion on the fused engine, on the fused engine with one effect in Python, and on the torch
reference. All three must agree, or nothing is printed.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import TypeVar

import torch

import torchcloth as tc
from torchcloth.effects import AbstractEffect, Amplitude
from torchcloth.engine.dispatch import Setting
from torchcloth.simulation.sensitivities import Directions

MAX_RELATIVE_SLOPE_DIFFERENCE = 1e-2  # of derivatives in float32
T = TypeVar("T")
PATHS: dict[str, tuple[Setting, bool]] = {
    "fused": ("fused", False),
    "fused, one effect in Python": ("fused", True),
    "reference": ("reference", False),
}
FABRIC_PARAMETERS = (
    "material.youngs_modulus.raw",
    "material.poisson_ratio.raw",
    "areal_density.raw",
    "effects.air.normal.raw",
)


class Pull(AbstractEffect):
    """A user's force on every vertex, so weak that all paths give the same positions."""

    amplitudes = {"strength": Amplitude(unit="N", typical=1e-12, smallest=1e-13)}

    def __init__(self) -> None:
        super().__init__()
        self.strength = tc.PhysicalParameter(1e-12, "N", "nonnegative", name="pull")

    def coefficients(self):
        """Return the strength of the effect."""
        return self.strength.field

    def force(self, c, now):
        """Return a force away from the origin."""
        return c * now.x


def sheet(engine: Setting, python: bool, contact: tc.Contact | None = None, cells: int = 20) -> tc.Cloth:
    """Return a sheet of 0.5 m with so many cells a side: by default 441 vertices and 800 triangles."""
    effects = {"gravity": tc.effects.Gravity(), "air": tc.effects.AirDrag(1.2), "bending": tc.effects.Bending(1e-5)}
    if python:
        effects["pull"] = Pull()
    mesh = tc.meshes.rectangle(0.5, 0.5, resolution=(cells + 1, cells + 1))
    hands = {"hand": tc.boundaries.Grasp.corner("upper-left")}
    return tc.Cloth(mesh, tc.materials.AEP(6e4, 0.3), 0.15, effects, hands, contact=contact, engine=engine)


def motion(end: float) -> dict[str, tc.Trajectory]:
    """Return the motion of a hand that rises."""
    pose = torch.eye(4).repeat(9, 1, 1)
    pose[:, 2, 3] = torch.linspace(0.0, 0.2, 9) ** 2
    return {"hand": tc.Trajectory(torch.linspace(0.0, end, 9), pose, torch.ones(9, dtype=torch.bool))}


def seconds(work: Callable[[], T], repeats: int) -> tuple[float, T]:
    """Return the time of the fastest of some runs [s], and the result."""
    taken = []
    while True:
        begin = time.perf_counter()
        out = work()
        taken.append(time.perf_counter() - begin)
        if len(taken) == repeats:
            return min(taken), out


def main() -> None:
    """Print the table of all paths."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=6, help="at 30 Hz")
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    for name in ("frames", "repeats"):
        if getattr(options, name) < 1:
            parser.error(f"--{name}: got {getattr(options, name)}, expected 1 or more")
    times = [k / 30 for k in range(options.frames + 1)]
    rows, ends = [], []
    for name, (engine, python) in PATHS.items():
        cloth = sheet(engine, python)
        state, driven = cloth.rest_state(), motion(times[-1])
        along = Directions(
            {n: row.clone() for n, row in zip(FABRIC_PARAMETERS, torch.eye(len(FABRIC_PARAMETERS)), strict=True)}
        )

        def forward(cloth=cloth, state=state, driven=driven):
            with torch.no_grad():
                return cloth(state, driven, times)

        def gradient(cloth=cloth, state=state, driven=driven):
            cloth.zero_grad()
            cloth(state, driven, times).x.pow(2).sum().backward()
            return torch.stack([cloth.get_parameter(name).grad for name in FABRIC_PARAMETERS])  # type: ignore[arg-type]

        def tangents(cloth=cloth, state=state, driven=driven, along=along):
            return cloth.sensitivities(state, driven, times, along=along)

        best, out = seconds(forward, options.repeats)
        slope, slopes = seconds(gradient, options.repeats)
        moves, (_, moved) = seconds(tangents, options.repeats)
        ends.append((out.x, slopes, moved.x))
        rows.append((name, best, slope, moves))
        substeps = sum(cloth.schedule(state, driven, times, None).counts)
    for x, slopes, moved in ends[1:]:
        torch.testing.assert_close(x, ends[0][0], rtol=0, atol=1e-4)
        torch.testing.assert_close(
            slopes,
            ends[0][1],
            rtol=MAX_RELATIVE_SLOPE_DIFFERENCE,
            atol=MAX_RELATIVE_SLOPE_DIFFERENCE * float(ends[0][1].abs().max()),
        )
        torch.testing.assert_close(
            moved,
            ends[0][2],
            rtol=MAX_RELATIVE_SLOPE_DIFFERENCE,
            atol=MAX_RELATIVE_SLOPE_DIFFERENCE * float(ends[0][2].abs().max()),
        )
    print(f"{substeps} substeps of 800 triangles, {torch.get_num_threads()} thread(s), {torch.get_default_dtype()}\n")
    print(f"| path | forward | gradient | {len(FABRIC_PARAMETERS)} tangents | per substep |\n|---|---|---|---|---|")
    for name, value, slope, moves in rows:
        print(f"| {name} | {value:.3f} s | {slope:.3f} s | {moves:.3f} s | {1e6 * value / substeps:.0f} us |")


if __name__ == "__main__":
    main()
