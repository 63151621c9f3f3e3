"""``torchcloth bench``: speed and memory, measured."""

from __future__ import annotations

import argparse
from typing import Any

from .folders import check_folder, place


def add(verbs: Any) -> None:
    """The verb and its options."""
    bench = verbs.add_parser("bench", help="measure speed and memory, also beside other simulators")
    bench.add_argument("--peers", action="store_true", help="beside Taichi, Warp, Newton, MuJoCo, where installed")
    bench.add_argument("--json", action="store_true", help="one JSON object on stdout instead of tables")
    bench.add_argument("--out", type=place, metavar="DIR", help="folder for bench.json and a plot of cost by size")
    bench.add_argument("--fast", action="store_true", help="tiny scenes: whether it works, not how fast it is")
    bench.add_argument("--threads", type=int, metavar="N", help="of each contestant that can use them (all cores)")
    bench.set_defaults(run=_bench)


def _bench(options: argparse.Namespace) -> int:
    if options.out is not None:
        check_folder(options.out)
    from ..benchmarks import command  # pyright: ignore[reportMissingImports] - mapped from benchmarks/ at installation

    return command.run(options)
