"""``torchcloth bench``: measure, and say it as tables or as one JSON object."""

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
from .cases import engines, make
from .contestants import PEERS, absent, versions
from .ratios import CONVENTIONS, ratios
from .suite import Bench, Plan
from .worker import Failed


def run(options: argparse.Namespace) -> int:
    """The verb.

    Raises:
        InvalidInput: an argument that makes no sense.
    """
    threads = os.cpu_count() or 1 if options.threads is None else options.threads
    if threads < 1:
        raise InvalidInput("--threads", got=threads, expected="at least 1")
    missing = absent() if options.peers else {}
    peers = tuple(name for name in PEERS if options.peers and name not in missing)
    plan = (Plan.quick if options.fast else Plan)(tuple(engines()), peers, threads)
    result = measured(plan) | {"absent": missing}
    if options.out is not None:
        write_text(options.out / "bench.json", json.dumps(result, indent=1) + "\n")
        report.plot(result, options.out)
    if options.json:
        print(json.dumps(result))
    else:
        report.show(result)
    return 0


def measured(plan: Plan) -> dict[str, Any]:
    """Everything but who is absent."""
    torch.set_default_dtype(torch.float32)
    torch.set_num_threads(plan.threads)
    machine = limits.machine(plan.threads) | {"versions": versions()}
    found = limits.measure(plan.threads)
    with Bench(plan, _tell) as bench:
        bench.run()
    records, notes = dict(bench.records), dict(bench.notes)
    for name, measure in {"start-up": footprint.start_up, "memory": footprint.memory}.items():
        _tell(name)
        try:
            records |= measure(plan)
        except Failed as error:
            notes[name] = str(error)
    best = plan.engines[0]
    return {
        "machine": machine,
        "limits": found._asdict() | {"distance": _distances(records, plan, found)},
        "cases": records,
        "ratios": ratios(records, best),
        "conventions": CONVENTIONS,
        "notes": notes,
    }


def _distances(records: dict[str, Any], plan: Plan, found: limits.Limits) -> dict[str, Any]:
    """Of the standard case, with all triangles on the grid."""
    case = make("standard-everywhere", plan.fast)
    least = limits.counts(case, case.triangles)
    keys = {name: f"forward.{case.name}.{name}" for name in (*plan.engines, *plan.peers)}
    return {
        name: found.distance(least, records[key]["seconds"] / records[key]["substeps"])
        for name, key in keys.items()
        if key in records
    }


def _tell(text: str) -> None:
    """Progress; stdout is for the result."""
    print(f"bench: {text}", file=sys.stderr, flush=True)
