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
from .suite import Plan, Record, record
from .worker import Failed, Worker

LONG = 20_000  # substeps of a long manipulation: 3.2 s
WARM_UP = 10  # substeps

START = """
import time
start = time.perf_counter()
import torchcloth
imported = time.perf_counter() - start
from torchcloth.benchmarks.contestant import Task
from torchcloth.benchmarks.contestants import build
run = build({engine!r}, {threads}).prepare(Task({case!r}, {quantity!r}, {substeps}, small={small}))
outcome = run()
import json
print(json.dumps({{"seconds": time.perf_counter() - start, "import_seconds": imported, "x": outcome.x.tolist()}}))
"""


def memory(plan: Plan) -> dict[str, Record]:
    """Peaks by key: a gradient over a long manipulation, and tangents over one and ten times the steps."""
    long, short = (LONG if plan.engines[0] != "reference" else 500), 250
    if plan.fast:
        long, short = 20, 4
    tasks = {
        "memory.gradient.garment": Task("garment", "gradient", long, small=plan.fast),
        "memory.tangents8.standard-usual.x1": Task("standard-usual", "tangents8", short, small=plan.fast),
        "memory.tangents8.standard-usual.x10": Task("standard-usual", "tangents8", 10 * short, small=plan.fast),
    }
    return {f"{key}.{plan.engines[0]}": peak(task, plan.engines[0], plan.threads) for key, task in tasks.items()}


def peak(task: Task, name: str, threads: int) -> Record:
    """Time, and memory [MiB] above that of the same contestant when it has run the scene briefly.

    Raises:
        Failed: the contestant's process ended, or the physics is wrong.
    """
    with Worker(name, threads) as worker:
        worker.prepare(replace(task, substeps=WARM_UP))
        worker.forget()
        base = worker.build(task)
        seconds = worker.sample(task, 0.0)
        outcome, highest = worker.result(task)
    case = task.scene()
    wrong = guards.problems(case, task.substeps, outcome.x)
    if wrong:
        raise Failed("; ".join(wrong))
    found = record(task, case.triangles, Timing.of([seconds]))
    return found | {"peak_mebibytes": round(highest - base, 1), "base_mebibytes": round(base, 1)}


def start_up(plan: Plan, repeats: int = 3) -> dict[str, Record]:
    """Seconds from ``import torchcloth`` to a first result, by key; the best of ``repeats`` fresh interpreters."""
    found = {}
    for engine in plan.engines[:1] if plan.fast else plan.engines:
        for quantity in ("forward", "gradient"):
            runs = [_start(engine, quantity, plan) for _ in range(1 if plan.fast else repeats)]
            found[f"startup.{quantity}.{engine}"] = min(runs, key=lambda run: run["seconds"])
    return found


def _start(engine: str, quantity: Any, plan: Plan) -> Record:
    task = Task("standard", quantity, 10 if plan.fast else 50, small=plan.fast)
    values = {"case": task.case, "quantity": quantity, "substeps": task.substeps, "small": task.small}
    code = START.format(engine=engine, threads=plan.threads, **values)
    environment = {**os.environ, "OMP_NUM_THREADS": str(plan.threads)}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
    if done.returncode:
        raise Failed(f"start-up of {engine}: {(done.stderr.strip().splitlines() or ['no message'])[-1]}")
    answer = json.loads(done.stdout.splitlines()[-1])
    wrong = guards.problems(task.scene(), task.substeps, np.array(answer.pop("x")))
    if wrong:
        raise Failed(f"start-up of {engine}: {'; '.join(wrong)}")
    return answer | {"substeps": task.substeps, "triangles": task.scene().triangles}
