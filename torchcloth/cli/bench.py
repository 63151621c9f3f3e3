"""``torchcloth bench``: measure speed and memory."""

from __future__ import annotations

import argparse
from typing import Any

from .output_paths import check_output_folder, output_path


def add(verbs: Any) -> None:
    """Add the verb and its options."""
    bench = verbs.add_parser("bench", help="measure speed and memory, on request beside other simulators")
    bench.add_argument(
        "--peers", action="store_true", help="also measure Taichi, Warp, Newton and MuJoCo, if they are installed"
    )
    bench.add_argument("--json", action="store_true", help="print one JSON object instead of tables")
    bench.add_argument(
        "--out", type=output_path, metavar="DIR", help="folder for bench.json and a plot of cost by size"
    )
    bench.add_argument("--fast", action="store_true", help="use tiny scenes, to test the benchmark itself")
    bench.add_argument(
        "--threads", type=int, metavar="N", help="threads of each contestant that can use several (default: all cores)"
    )
    bench.set_defaults(run=_bench)


def _bench(options: argparse.Namespace) -> int:
    if options.out is not None:
        check_output_folder(options.out)
    from ..benchmarks import command  # pyright: ignore[reportMissingImports] - mapped from benchmarks/ at installation

    return command.run(options)
