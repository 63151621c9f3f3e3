"""What a batch costs on the CPU: ``python -m torchcloth.benchmarks.batches``.

Sixteen scenes in float32 and eight in float64 share the lanes of a processor's packs. The table has their time over
that of one scene, beside the time of the same batch with scenes one by one. One thread; all runs take turns.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import torch

from torchcloth.engine.execution import min_filled_lanes

from .cases import Case, Scene, build_scene, make_case
from .ours import end_positions

SUBSTEPS_PER_RUN, TIMED_REPEATS = 250, 5
SCENES_IN_LANES = {torch.float32: 16, torch.float64: 8}
ALL_LANES = 1.0  # share of a pack's lanes; more than that can never be filled


def main() -> None:
    """Measure all cases and print their table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fast", action="store_true", help="small meshes, one repetition: shows only that it works")
    options = parser.parse_args()
    torch.set_num_threads(1)
    print("| cloth without contact | precision | scenes | run | one scene, us per substep | batch | one by one |")
    print("|---|---|---:|---|---:|---:|---:|")
    for case in cloths(options.fast):
        for dtype, scenes in SCENES_IN_LANES.items():
            for quantity in ("forward", "gradient"):
                one, lanes, alone = time_batch(case, dtype, scenes, quantity, 1 if options.fast else TIMED_REPEATS)
                precision = str(dtype).removeprefix("torch.")
                print(
                    f"| {case.name} | {precision} | {scenes} | {quantity} | {one / SUBSTEPS_PER_RUN * 1e6:.1f} | "
                    f"{lanes / one:.1f} | {alone / one:.1f} |",
                    flush=True,
                )


def cloths(small: bool) -> Iterator[Case]:
    """Return sheets and a shirt whose layers do not touch."""
    yield make_case("sheet-800", small)
    for name in ("standard-usual", "garment"):
        yield replace(make_case(name, small), contact=None, expected_warning=None, boundaries=dict)


def time_batch(case: Case, dtype: torch.dtype, scenes: int, quantity: str, repeats: int) -> tuple[float, float, float]:
    """Return the least times [s of the processor] of one scene, of a batch, and of the same batch one by one."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        one, batch = (build_scene(case, "fused", SUBSTEPS_PER_RUN, count) for count in (0, scenes))
    finally:
        torch.set_default_dtype(before)
    runs: list[Callable[[], None]] = [partial(simulate, one, quantity), partial(simulate, batch, quantity)]
    runs.append(partial(_run_one_by_one, runs[1]))
    times = [[processor_seconds(run) for run in runs] for _ in range(repeats + 1)]
    least = [min(column) for column in zip(*times[1:], strict=True)]
    return least[0], least[1], least[2]


def simulate(scene: Scene, quantity: str) -> None:
    """Run a scene, or its gradient by the initial positions and all parameters."""
    x = scene.x.clone().requires_grad_(quantity == "gradient")
    with torch.set_grad_enabled(quantity == "gradient"):
        end = end_positions(scene, x, scene.motion)
    if quantity == "gradient":
        (end**2).mean().backward()


def processor_seconds(run: Callable[[], None]) -> float:
    """Return the time of the processor for a run [s]."""
    start = time.process_time()
    run()
    return time.process_time() - start


def _run_one_by_one(run: Callable[[], None]) -> None:
    with min_filled_lanes(2 * ALL_LANES):
        run()


if __name__ == "__main__":
    main()
