"""``torchcloth bench``: measure, and print tables or one JSON object."""

from __future__ import annotations

import argparse
import json
import os
import sys
from typing import Any

import torch

from torchcloth._utils.files import write_text
from torchcloth.errors import InvalidInput

from . import footprint, limits, report
from .cases import engines, make_case
from .contestants import PEERS, missing_peers, versions
from .ratios import CONVENTIONS, ratios
from .suite import Bench, BenchPlan
from .worker import ContestantFailed

SCHEMA = "torchcloth.bench/1"


def run(options: argparse.Namespace) -> int:
    """Run the command and return its exit code.

    Raises:
        InvalidInput: an argument makes no sense.
    """
    threads = os.cpu_count() or 1 if options.threads is None else options.threads
    if threads < 1:
        raise InvalidInput("--threads", got=threads, expected="at least 1")
    missing = missing_peers() if options.peers else {}
    peers = tuple(name for name in PEERS if options.peers and name not in missing)
    plan = (BenchPlan.quick if options.fast else BenchPlan)(tuple(engines()), peers, threads)
    result = {"schema": SCHEMA} | run_benchmarks(plan) | {"missing_peers": missing}
    if options.out is not None:
        write_text(options.out / "bench.json", json.dumps(result, indent=1) + "\n")
        report.plot(result, options.out)
    if options.json:
        print(json.dumps(result))
    else:
        report.show(result)
    return 0


def run_benchmarks(plan: BenchPlan) -> dict[str, Any]:
    """Return all measurements of a plan."""
    torch.set_default_dtype(torch.float32)
    torch.set_num_threads(plan.threads)
    machine = limits.machine(plan.threads) | {"versions": versions()}
    machine_limits = limits.measure(plan.threads)
    with Bench(plan, _print_progress) as bench:
        bench.run()
    records, notes = dict(bench.records), dict(bench.notes)
    for name, measure in {"start-up": footprint.start_up, "memory": footprint.memory}.items():
        _print_progress(name)
        try:
            records |= measure(plan)
        except ContestantFailed as error:
            notes[name] = str(error)
    best = plan.engines[0]
    return {
        "machine": machine,
        "limits": machine_limits._asdict() | {"distance": _distances(records, plan, machine_limits)},
        "cases": records,
        "ratios": ratios(records, best),
        "conventions": CONVENTIONS,
        "notes": notes,
    }


def _distances(records: dict[str, Any], plan: BenchPlan, machine_limits: limits.Limits) -> dict[str, Any]:
    """Distances from the limits in the standard case, with all triangles on the grid."""
    case = make_case("standard-everywhere", plan.fast)
    minimum = limits.count_operations(case, case.triangles)
    keys = {name: f"forward.{case.name}.{name}" for name in (*plan.engines, *plan.peers)}
    return {
        name: machine_limits.distance(minimum, records[key]["seconds"] / records[key]["substeps"])
        for name, key in keys.items()
        if key in records
    }


def _print_progress(text: str) -> None:
    """Print progress to stderr; stdout is for the result."""
    print(f"bench: {text}", file=sys.stderr, flush=True)
