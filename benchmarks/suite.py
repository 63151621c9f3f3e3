"""The list of measurements, and running them: contestants take turns, so that a busy moment hits all of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from . import contestants, guards
from .contestant import Outcome, Quantity, Task, Unsupported
from .measure import SHORTEST, Timing
from .worker import Failed, Worker

Record = dict[str, Any]
SECOND = 6250  # substeps of DT
COMPARED = 250  # substeps at most for which float32 lets contestants be compared: a swinging sheet is chaotic
ENOUGH = 5.0  # s, of samples of one contestant
MPM, MESH = ("taichi", "warp"), ("newton", "mujoco")
SIZES = (200, 800, 3200, 10_000, 20_000)


@dataclass(frozen=True)
class Plan:
    """How much is measured, and by whom."""

    engines: tuple[str, ...]  # the best first
    peers: tuple[str, ...] = ()
    threads: int = 2
    samples: int = 5
    shortest: float = SHORTEST  # s, of a sample
    fast: bool = False  # tiny scenes, few substeps: whether it works, not how fast

    @classmethod
    def quick(cls, engines: tuple[str, ...], peers: tuple[str, ...], threads: int) -> Plan:
        """For tests."""
        return cls(engines, peers, threads, samples=1, shortest=0.0, fast=True)


@dataclass(frozen=True)
class Entry:
    """One task for several contestants."""

    task: Task
    names: tuple[str, ...]
    label: str = ""  # in the record's key, where the task alone does not say it

    def key(self, name: str) -> str:
        """Of its record: quantity.case[.batch-N][.label].contestant"""
        task = self.task
        parts = [task.quantity, task.case, f"batch-{task.batch}" if task.batch else "", self.label, name]
        return ".".join(part for part in parts if part)


def entries(plan: Plan) -> list[Entry]:
    """What is timed."""
    best, all_engines = plan.engines[:1], plan.engines
    mpm, mesh = (tuple(name for name in group if name in plan.peers) for group in (MPM, MESH))
    found = [
        Entry(Task("standard-everywhere", "forward", 250), all_engines + mpm),
        Entry(Task("standard-everywhere", "gradient", 250), all_engines + mpm),
        Entry(Task("sheet-800", "forward", 250), all_engines + mesh),
        Entry(Task("sheet-800", "gradient", 250), all_engines + mesh),
        Entry(Task("standard", "forward", 250), all_engines + tuple(n for n in mesh if n == "newton")),
        *(Entry(Task(case, q, 250), all_engines) for case, q in _EACH),
        *(Entry(Task("standard", "forward", 250, batch), best) for batch in (1, 8, 32)),
        *(Entry(Task(f"sheet-{size}", "forward", 250), best, "size") for size in SIZES),
        *(Entry(Task("sheet-800", "forward", count), best, f"steps-{count}") for count in (250, 2500)),
        Entry(Task("standard", "forward", SECOND), all_engines, "1s"),
        Entry(Task("standard", "gradient", SECOND), best, "1s"),
        Entry(Task("standard-everywhere", "forward", SECOND), best + mpm, "1s"),
    ]
    return [_small(entry) for entry in found] if plan.fast else found


_QUANTITIES: tuple[Quantity, ...] = ("forward", "gradient", "tangents8")
_EACH: list[tuple[str, Quantity]] = [
    ("standard-everywhere", "tangents8"),
    ("standard", "gradient"),
    ("standard", "tangents8"),
    *((case, quantity) for case in ("standard-usual", "garment") for quantity in _QUANTITIES),
]


def _small(entry: Entry) -> Entry:
    """The same on the smallest meshes for few substeps."""
    names = entry.names
    if entry.task.quantity == "gradient":
        names = tuple(name for name in names if name != "taichi")  # it compiles for minutes
    fewest = 100 if entry.task.quantity == "gradient" else 4  # dE of a sheet that hardly moved is rounding
    substeps = max(fewest, entry.task.substeps // 60)
    return replace(entry, task=replace(entry.task, small=True, substeps=substeps), names=names)


@dataclass
class Bench:
    """Measurements so far."""

    plan: Plan
    tell: Callable[[str], None] = lambda text: None
    records: dict[str, Record] = field(default_factory=dict)
    notes: dict[str, str] = field(default_factory=dict)  # what a contestant could not do, by the record's key
    _workers: dict[str, Worker] = field(default_factory=dict)
    _usual: dict[Task, Outcome] = field(default_factory=dict)

    def __enter__(self) -> Bench:
        return self

    def __exit__(self, *error: object) -> None:
        for worker in self._workers.values():
            worker.close()

    def run(self) -> None:
        """All entries."""
        for entry in entries(self.plan):
            self.tell(f"{entry.task.quantity}, {entry.task.case}, {entry.task.substeps} substeps")
            self.measure(entry)

    def measure(self, entry: Entry) -> None:
        """Time one entry: every contestant in turn, as often as asked."""
        prepared = {name: seconds for name in entry.names if (seconds := self._prepared(entry, name)) is not None}
        samples: dict[str, list[float]] = {name: [] for name in prepared}
        for _ in range(self.plan.samples):
            for name, taken in samples.items():
                if name in self._workers and sum(taken) < ENOUGH:
                    try:
                        taken.append(self._workers[name].sample(self.plan.shortest))
                    except Failed as error:
                        self._lose(entry, name, error)
        self._judge(entry, prepared, {name: taken for name, taken in samples.items() if name in self._workers})

    def _prepared(self, entry: Entry, name: str) -> float | None:
        """Seconds of building, compiling and a first run; None if the contestant cannot do it."""
        try:
            if name not in self._workers:
                self._workers[name] = Worker(name, self.plan.threads)
            return self._workers[name].prepare(entry.task)
        except Unsupported as error:
            self.notes[entry.key(name)] = str(error)
        except Failed as error:
            self._lose(entry, name, error)
        return None

    def _lose(self, entry: Entry, name: str, error: Failed) -> None:
        """Its next task starts in a new process."""
        self.notes[entry.key(name)] = str(error)
        if name in self._workers:
            self._workers.pop(name).close()

    def _judge(self, entry: Entry, prepared: dict[str, float], samples: dict[str, list[float]]) -> None:
        """Keep the timings whose physics holds."""
        case = entry.task.scene()
        outcomes = {name: self._workers[name].result()[0] for name in samples}
        faults = {
            name: guards.problems(case, entry.task.substeps, found.x) + _derivatives(entry.task, found)
            for name, found in outcomes.items()
        }
        sound = [name for name, wrong in faults.items() if not wrong]
        first = outcomes.get("reference" if "reference" in sound else next(iter(sound), ""))
        for name, taken in samples.items():
            worker, key, outcome, wrong = self._workers[name], entry.key(name), outcomes[name], faults[name]
            if entry.task.substeps <= COMPARED and not wrong and first is not None:
                truth, limit = self._truth(entry.task, name, first)
                derivative = guards.ROUNDED if entry.task.small else guards.DERIVATIVE
                wrong = guards.disagreement(case, truth, outcome, limit, derivative)
            if wrong:
                self.notes[key] = "not counted: " + "; ".join(wrong)
                continue
            self.records[key] = record(entry.task, case.triangles, Timing.of(taken)) | {
                "threads": worker.threads,
                "prepare_seconds": prepared[name],
                "apart_m": guards.apart(outcome.x if first is None else first.x, outcome.x),
            }

    def _truth(self, task: Task, name: str, first: Outcome) -> tuple[Outcome, float]:
        """What a contestant must find, and how closely; ``first``: the reference's result, else the first sound one.

        For MPM torchcloth's own "apic".
        """
        if name not in contestants.PEERS:
            return first, guards.SAME
        if name not in MPM:
            return first, guards.OTHER
        usual = replace(task, case="standard-apic")
        if usual not in self._usual:
            self._usual[usual] = contestants.build("reference", 1).prepare(usual)()
        return self._usual[usual], guards.SAME


def record(task: Task, triangles: int, timing: Timing) -> Record:
    """What JSON says of a timing."""
    return {
        "seconds": timing.median,
        "minimum_seconds": timing.minimum,
        "samples": timing.samples,
        "substeps": task.substeps,
        "triangles": triangles,
        "batch": task.batch,
        "ms_per_substep": 1e3 * timing.median / task.substeps,
    }


def _derivatives(task: Task, outcome: Outcome) -> list[str]:
    if task.quantity == "forward":
        return []
    arrays = [np.asarray(part) for part in outcome.extra]
    if task.quantity == "gradient":
        arrays += [np.asarray(outcome.by_x), np.asarray(outcome.by_youngs)]
    return guards.derivative_problems(arrays)
