"""The list of measurements, and running them: what is compared takes turns, so that a busy moment hits all of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
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
QUANTITIES: tuple[Quantity, ...] = ("forward", "gradient", "tangents8")


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


def rounds(plan: Plan) -> list[list[Entry]]:
    """What is timed; the entries of a round take turns, for ratios between them."""
    best, all_engines = plan.engines[:1], plan.engines
    mpm, mesh = (tuple(name for name in group if name in plan.peers) for group in (MPM, MESH))
    newton = tuple(name for name in mesh if name == "newton")
    found = [
        [
            Entry(Task("standard-everywhere", "forward", 250), all_engines + mpm),
            Entry(Task("standard", "forward", 250), all_engines + newton),
            Entry(Task("standard-everywhere", "gradient", 250), all_engines + mpm),
            Entry(Task("standard", "gradient", 250), all_engines),
            Entry(Task("standard-everywhere", "tangents8", 250), all_engines),
            Entry(Task("standard", "tangents8", 250), all_engines),
        ],
        *([Entry(Task(case, q, 250), all_engines) for q in QUANTITIES] for case in ("standard-usual", "garment")),
        [Entry(Task("sheet-800", quantity, 250), all_engines + mesh) for quantity in QUANTITIES[:2]],
        [Entry(Task("standard", "forward", 250, batch), best) for batch in (1, 8, 32)],
        [Entry(Task(f"sheet-{size}", "forward", 250), best, "size") for size in SIZES],
        [Entry(Task("sheet-800", "forward", count), best, f"steps-{count}") for count in (250, 2500)],
        [
            Entry(Task("standard", "forward", SECOND), all_engines, "1s"),
            Entry(Task("standard", "gradient", SECOND), best, "1s"),
            Entry(Task("standard-everywhere", "forward", SECOND), best + mpm, "1s"),
        ],
    ]
    return [[_small(entry) for entry in entries] for entries in found] if plan.fast else found


def _small(entry: Entry) -> Entry:
    """The same on the smallest meshes for few substeps."""
    names = entry.names
    if entry.task.quantity == "gradient":
        names = tuple(name for name in names if name != "taichi")  # it compiles for minutes
    fewest = 100 if entry.task.quantity == "gradient" else 4  # dE of a sheet that hardly moved is rounding
    substeps = max(fewest, entry.task.substeps // 60)
    return replace(entry, task=replace(entry.task, small=True, substeps=substeps), names=names)


@dataclass
class Turn:
    """A contestant that is ready for an entry."""

    worker: Worker
    prepare_seconds: float  # of building, compiling and a first run
    samples: list[float] = field(default_factory=list)  # s, of one run


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
        """All rounds."""
        for entries in rounds(self.plan):
            self.measure(entries)

    def measure(self, entries: Sequence[Entry]) -> None:
        """Time one round: every contestant of every entry in turn, as often as asked."""
        turns: dict[tuple[Entry, str], Turn] = {}
        for entry in entries:
            self.tell(f"{entry.task.quantity}, {entry.task.case}, {entry.task.substeps} substeps")
            for name in entry.names:
                if (turn := self._prepared(entry, name)) is not None:
                    turns[entry, name] = turn
        for _ in range(self.plan.samples):
            for (entry, name), turn in turns.items():
                if self._workers.get(name) is turn.worker and sum(turn.samples) < ENOUGH:
                    try:
                        turn.samples.append(turn.worker.sample(entry.task, self.plan.shortest))
                    except Failed as error:
                        self._lose(entry, name, error)
        for (entry, name), turn in turns.items():
            if self._workers.get(name) is not turn.worker:
                self.notes.setdefault(entry.key(name), f"{name} ended in another task of this round")
        for entry in entries:
            self._judge(entry, {n: turns[entry, n] for n in entry.names if entry.key(n) not in self.notes})
        for name, worker in [*self._workers.items()]:
            try:
                worker.forget()
            except Failed:  # what it has measured counts
                self._workers.pop(name).close()

    def _prepared(self, entry: Entry, name: str) -> Turn | None:
        """Built, compiled and run once; None if the contestant cannot do it."""
        try:
            if name not in self._workers:
                self._workers[name] = Worker(name, self.plan.threads)
            worker = self._workers[name]
            return Turn(worker, worker.prepare(entry.task))
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

    def _judge(self, entry: Entry, turns: Mapping[str, Turn]) -> None:
        """Keep the timings whose physics holds."""
        case = entry.task.scene()
        outcomes: dict[str, Outcome] = {}
        for name, turn in turns.items():
            try:
                outcomes[name] = turn.worker.result(entry.task)[0]
            except Failed as error:
                self._lose(entry, name, error)
        turns = {name: turns[name] for name in outcomes}
        faults = {
            name: guards.problems(case, entry.task.substeps, found.x) + _derivatives(entry.task, found)
            for name, found in outcomes.items()
        }
        sound = [name for name, wrong in faults.items() if not wrong]
        first = outcomes.get("reference" if "reference" in sound else next(iter(sound), ""))
        for name, turn in turns.items():
            key, outcome, wrong = entry.key(name), outcomes[name], faults[name]
            if entry.task.substeps <= COMPARED and not wrong and first is not None:
                truth, limit = self._truth(entry.task, name, first)
                derivative = guards.ROUNDED if entry.task.small else guards.DERIVATIVE
                wrong = guards.disagreement(case, truth, outcome, limit, derivative)
            if wrong:
                self.notes[key] = "not counted: " + "; ".join(wrong)
                continue
            self.records[key] = record(entry.task, case.triangles, Timing.of(turn.samples)) | {
                "threads": turn.worker.threads,
                "prepare_seconds": turn.prepare_seconds,
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
