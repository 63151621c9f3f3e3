"""Compare the swing of the shipped example with MuJoCo and Newton, which read an exported cloth.

    python -m torchcloth.training.validation.export [--engine mujoco semi-implicit vbd] [--nominal] [--seconds S]

Prints a table. Each engine takes two to three minutes of one core. The last two are Newton's solvers, on the CPU (``pip
install newton``).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator

import torch

from torchcloth import recordings
from torchcloth.episodes.recorded_cloth import build_cloth
from torchcloth.errors import MissingDependency
from torchcloth.export import export_cloth

from .mujoco_replay import replay_in_mujoco
from .newton_replay import newton, replay_in_newton
from .swing import EXAMPLE, Array, Swing, build_fitted_cloth, simulate_swing

NEWTON_SOLVERS = {"semi-implicit": ("SolverSemiImplicit", 1e-4), "vbd": ("SolverVBD", 1 / 600)}  # step [s]


def replay_in(engine: str, swing: Swing) -> Iterator[tuple[str, Array]]:
    """Yield the variants of an engine and their positions [T, V, 3] m."""
    if engine == "mujoco":
        text = export_cloth(swing.cloth, "mujoco").text
        yield "as exported", replay_in_mujoco(text, swing)
        yield "damping 0", replay_in_mujoco(text, swing, damping=0.0)
        yield "drag on triangles instead", replay_in_mujoco(text, swing, "triangles")
        yield "no drag", replay_in_mujoco(text, swing, "none")
        return
    if newton is None:
        raise MissingDependency("Newton", got="none", expected="newton >= 1.8", remedy="pip install newton")
    text, solver, step = export_cloth(swing.cloth, "newton").text, *NEWTON_SOLVERS[engine]
    yield "as exported" if engine != "vbd" else "drag as forces", replay_in_newton(text, swing, solver, step)
    yield "no drag" if engine != "vbd" else "as exported", replay_in_newton(text, swing, solver, step, has_drag=False)


def main(arguments: list[str]) -> int:
    """Print the table; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m torchcloth.training.validation.export", description=__doc__)
    parser.add_argument("--nominal", action="store_true", help="data-sheet values instead of the fitted ones")
    parser.add_argument("--seconds", type=float, help="simulated time (default: the whole swing, 2.2 s)")
    engines = ("mujoco", *NEWTON_SOLVERS)
    parser.add_argument("--engine", nargs="+", choices=engines, default=["mujoco"], help="engines (default: mujoco)")
    options = parser.parse_args(arguments)
    torch.set_default_dtype(torch.float64)
    torch.set_num_threads(1)
    recording = recordings.read(EXAMPLE)
    cloth = build_cloth(recording) if options.nominal else build_fitted_cloth(recording)
    swing = simulate_swing(cloth, recording, options.seconds)
    print("| engine | variant | rms, mm | largest, mm |\n|---|---|---|---|")
    for engine in options.engine:
        for variant, x in replay_in(engine, swing):
            rms, largest = 1e3 * swing.rms_distance(x), 1e3 * swing.max_distance(x)
            print(f"| {engine} | {variant} | {rms:.2f} | {largest:.1f} |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
