"""Peak memory and start-up time, each in a fresh process."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from typing import Any

import numpy as np

from . import guards
from .contestant import Task
from .measure import Timing
from .suite import BenchPlan, Record, record
from .worker import ContestantFailed, Worker

LONG_ROLLOUT_SUBSTEPS = 20_000  # a long manipulation: 3.2 s
WARM_UP_SUBSTEPS = 10

START_UP_SCRIPT = """
import time
start = time.perf_counter()
import torchcloth
imported = time.perf_counter() - start
from torchcloth.benchmarks.contestant import Task
from torchcloth.benchmarks.contestants import build_contestant
run = build_contestant({engine!r}, {threads}).prepare(Task({case!r}, {quantity!r}, {substeps}, small={small}))
outcome = run()
import json
print(json.dumps({{"seconds": time.perf_counter() - start, "import_seconds": imported, "x": outcome.x.tolist()}}))
"""


def memory(plan: BenchPlan) -> dict[str, Record]:
    """Return memory peaks by key: a gradient over a long manipulation, tangents over 1 and 10 times the substeps."""
    long, short = (LONG_ROLLOUT_SUBSTEPS if plan.engines[0] != "reference" else 500), 250
    if plan.fast:
        long, short = 20, 4
    tasks = {
        "memory.gradient.garment": Task("garment", "gradient", long, small=plan.fast),
        "memory.tangents8.standard-usual.x1": Task("standard-usual", "tangents8", short, small=plan.fast),
        "memory.tangents8.standard-usual.x10": Task("standard-usual", "tangents8", 10 * short, small=plan.fast),
    }
    return {f"{key}.{plan.engines[0]}": peak(task, plan.engines[0], plan.threads) for key, task in tasks.items()}


def peak(task: Task, name: str, threads: int) -> Record:
    """Return time and memory [MiB] above that of the same contestant after a brief run of the scene.

    Raises:
        ContestantFailed: the contestant's process ended, or its result fails the checks.
    """
    with Worker(name, threads) as worker:
        worker.prepare(replace(task, substeps=WARM_UP_SUBSTEPS))
        worker.forget()
        base = worker.build(task)
        seconds = worker.sample(task, 0.0)
        outcome, highest = worker.result(task)
    case = task.build_case()
    wrong = guards.physics_violations(case, task.substeps, outcome.x)
    if wrong:
        raise ContestantFailed("; ".join(wrong))
    timing = record(task, case.triangles, Timing.of([seconds]))
    return timing | {"peak_mebibytes": round(highest - base, 1), "base_mebibytes": round(base, 1)}


def start_up(plan: BenchPlan, repeats: int = 3) -> dict[str, Record]:
    """Return seconds from ``import torchcloth`` to a first result by key, the best of ``repeats`` new interpreters."""
    records = {}
    for engine in plan.engines[:1] if plan.fast else plan.engines:
        for quantity in ("forward", "gradient"):
            runs = [_start(engine, quantity, plan) for _ in range(1 if plan.fast else repeats)]
            records[f"startup.{quantity}.{engine}"] = min(runs, key=lambda run: run["seconds"])
    return records


def _start(engine: str, quantity: Any, plan: BenchPlan) -> Record:
    task = Task("standard", quantity, 10 if plan.fast else 50, small=plan.fast)
    values = {"case": task.case, "quantity": quantity, "substeps": task.substeps, "small": task.small}
    code = START_UP_SCRIPT.format(engine=engine, threads=plan.threads, **values)
    environment = {**os.environ, "OMP_NUM_THREADS": str(plan.threads)}
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
    if process.returncode:
        raise ContestantFailed(f"start-up of {engine}: {(process.stderr.strip().splitlines() or ['no message'])[-1]}")
    answer = json.loads(process.stdout.splitlines()[-1])
    wrong = guards.physics_violations(task.build_case(), task.substeps, np.array(answer.pop("x")))
    if wrong:
        raise ContestantFailed(f"start-up of {engine}: {'; '.join(wrong)}")
    return answer | {"substeps": task.substeps, "triangles": task.build_case().triangles}
