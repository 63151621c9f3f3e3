"""The list of measurements, and how they run: contestants that are compared take turns, so that load affects all."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from . import contestants, guards
from .contestant import Outcome, Quantity, Task, Unsupported
from .measure import MIN_SAMPLE_S, Timing
from .worker import ContestantFailed, Worker

Record = dict[str, Any]
SUBSTEPS_PER_SECOND = 6250  # of SUBSTEP_S
# float32 lets runs of at most so many substeps be compared: a swinging sheet is chaotic
MAX_COMPARED_SUBSTEPS = 250
MAX_SAMPLING_S = 5.0  # of one contestant
MPM_PEERS, MESH_PEERS = ("taichi", "warp"), ("newton", "mujoco")
SHEET_TRIANGLES = (200, 800, 3200, 10_000, 20_000)
QUANTITIES: tuple[Quantity, ...] = ("forward", "gradient", "tangents8")


@dataclass(frozen=True)
class BenchPlan:
    """What is measured.

    Attributes:
        engines: engines of torchcloth, the fastest first.
        peers: other simulators.
        threads: threads of each contestant.
        samples: samples of each computation.
        shortest: s, shortest sample.
        fast: small scenes and few substeps, which show only whether contestants work.
    """

    engines: tuple[str, ...]
    peers: tuple[str, ...] = ()
    threads: int = 2
    samples: int = 5
    shortest: float = MIN_SAMPLE_S
    fast: bool = False

    @classmethod
    def quick(cls, engines: tuple[str, ...], peers: tuple[str, ...], threads: int) -> BenchPlan:
        """Return a plan for tests."""
        return cls(engines, peers, threads, samples=1, shortest=0.0, fast=True)


@dataclass(frozen=True)
class Entry:
    """One task for several contestants.

    Attributes:
        task: the task.
        names: of the contestants.
        label: part of the record's key, where the task alone is not unique.
    """

    task: Task
    names: tuple[str, ...]
    label: str = ""

    def key(self, name: str) -> str:
        """Return the key of a contestant's record: quantity.case[.batch-N][.label].contestant"""
        task = self.task
        parts = [task.quantity, task.case, f"batch-{task.batch}" if task.batch else "", self.label, name]
        return ".".join(part for part in parts if part)


def measurement_rounds(plan: BenchPlan) -> list[list[Entry]]:
    """Return what is timed; the entries of a round take turns, for ratios between them."""
    best, all_engines = plan.engines[:1], plan.engines
    mpm, mesh = (tuple(name for name in group if name in plan.peers) for group in (MPM_PEERS, MESH_PEERS))
    newton = tuple(name for name in mesh if name == "newton")
    rounds = [
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
        [Entry(Task(f"sheet-{size}", "forward", 250), best, "size") for size in SHEET_TRIANGLES],
        [Entry(Task("sheet-800", "forward", count), best, f"steps-{count}") for count in (250, 2500)],
        [
            Entry(Task("standard", "forward", SUBSTEPS_PER_SECOND), all_engines, "1s"),
            Entry(Task("standard", "gradient", SUBSTEPS_PER_SECOND), best, "1s"),
            Entry(Task("standard-everywhere", "forward", SUBSTEPS_PER_SECOND), best + mpm, "1s"),
        ],
    ]
    return [[_small(entry) for entry in entries] for entries in rounds] if plan.fast else rounds


def _small(entry: Entry) -> Entry:
    """The same entry on the smallest meshes for few substeps."""
    names = entry.names
    if entry.task.quantity == "gradient":
        names = tuple(name for name in names if name != "taichi")  # its gradient compiles for minutes
    min_substeps = (
        100 if entry.task.quantity == "gradient" else 4
    )  # the derivative by E of a sheet that hardly moved is rounding
    substeps = max(min_substeps, entry.task.substeps // 60)
    return replace(entry, task=replace(entry.task, small=True, substeps=substeps), names=names)


@dataclass
class PreparedRun:
    """A contestant that is ready for an entry.

    Attributes:
        worker: its process.
        prepare_seconds: s, of building, compiling and a first run.
        samples: s, of one run each.
    """

    worker: Worker
    prepare_seconds: float
    samples: list[float] = field(default_factory=list)


@dataclass
class Bench:
    """A benchmark in progress.

    Attributes:
        plan: what is measured.
        report_progress: takes a line about what is measured next.
        records: timings by key.
        notes: reasons for missing timings, by the record's key.
    """

    plan: BenchPlan
    report_progress: Callable[[str], None] = lambda text: None
    records: dict[str, Record] = field(default_factory=dict)
    notes: dict[str, str] = field(default_factory=dict)
    _workers: dict[str, Worker] = field(default_factory=dict)
    _apic_outcomes: dict[Task, Outcome] = field(default_factory=dict)

    def __enter__(self) -> Bench:
        return self

    def __exit__(self, *error: object) -> None:
        for worker in self._workers.values():
            worker.close()

    def run(self) -> None:
        """Measure all rounds of all entries."""
        for entries in measurement_rounds(self.plan):
            self.measure(entries)

    def measure(self, entries: Sequence[Entry]) -> None:
        """Time one round: every contestant of every entry in turn, as many times as the plan has samples."""
        turns: dict[tuple[Entry, str], PreparedRun] = {}
        for entry in entries:
            self.report_progress(f"{entry.task.quantity}, {entry.task.case}, {entry.task.substeps} substeps")
            for name in entry.names:
                if (turn := self._prepare(entry, name)) is not None:
                    turns[entry, name] = turn
        for _ in range(self.plan.samples):
            for (entry, name), turn in turns.items():
                if self._workers.get(name) is turn.worker and sum(turn.samples) < MAX_SAMPLING_S:
                    try:
                        turn.samples.append(turn.worker.sample(entry.task, self.plan.shortest))
                    except ContestantFailed as error:
                        self._drop_worker(entry, name, error)
        for (entry, name), turn in turns.items():
            if self._workers.get(name) is not turn.worker:
                self.notes.setdefault(entry.key(name), f"{name} ended in another task of this round")
        for entry in entries:
            self._record_valid(entry, {n: turns[entry, n] for n in entry.names if entry.key(n) not in self.notes})
        for name, worker in [*self._workers.items()]:
            try:
                worker.forget()
            except ContestantFailed:  # its timings count
                self._workers.pop(name).close()

    def _prepare(self, entry: Entry, name: str) -> PreparedRun | None:
        """Build, compile and run once; None if the contestant cannot do the task."""
        try:
            if name not in self._workers:
                self._workers[name] = Worker(name, self.plan.threads)
            worker = self._workers[name]
            return PreparedRun(worker, worker.prepare(entry.task))
        except Unsupported as error:
            self.notes[entry.key(name)] = str(error)
        except ContestantFailed as error:
            self._drop_worker(entry, name, error)
        return None

    def _drop_worker(self, entry: Entry, name: str, error: ContestantFailed) -> None:
        """End a contestant's process; its next task starts in a new one."""
        self.notes[entry.key(name)] = str(error)
        if name in self._workers:
            self._workers.pop(name).close()

    def _record_valid(self, entry: Entry, turns: Mapping[str, PreparedRun]) -> None:
        """Record the timings of outcomes that pass the checks of the physics."""
        case = entry.task.build_case()
        outcomes: dict[str, Outcome] = {}
        for name, turn in turns.items():
            try:
                outcomes[name] = turn.worker.result(entry.task)[0]
            except ContestantFailed as error:
                self._drop_worker(entry, name, error)
        turns = {name: turns[name] for name in outcomes}
        violations = {
            name: guards.physics_violations(case, entry.task.substeps, outcome.x) + _derivatives(entry.task, outcome)
            for name, outcome in outcomes.items()
        }
        valid = [name for name, wrong in violations.items() if not wrong]
        first = outcomes.get("reference" if "reference" in valid else next(iter(valid), ""))
        for name, turn in turns.items():
            key, outcome, wrong = entry.key(name), outcomes[name], violations[name]
            if entry.task.substeps <= MAX_COMPARED_SUBSTEPS and not wrong and first is not None:
                expected, limit = self._expected(entry.task, name, first)
                derivative = guards.MAX_DERIVATIVE_ERROR_SMALL if entry.task.small else guards.MAX_DERIVATIVE_ERROR
                wrong = guards.disagreement(case, expected, outcome, limit, derivative)
            if wrong:
                self.notes[key] = "not counted: " + "; ".join(wrong)
                continue
            self.records[key] = record(entry.task, case.triangles, Timing.of(turn.samples)) | {
                "threads": turn.worker.threads,
                "prepare_seconds": turn.prepare_seconds,
                "rms_distance_m": guards.rms_distance(outcome.x if first is None else first.x, outcome.x),
            }

    def _expected(self, task: Task, name: str, first: Outcome) -> tuple[Outcome, float]:
        """Expected outcome of a contestant, and the allowed relative distance.

        ``first``: the reference's outcome, else the first valid one. For material point methods the expected outcome is
        torchcloth's own "apic".
        """
        if name not in contestants.PEERS:
            return first, guards.MAX_DISTANCE_SAME_SCHEME
        if name not in MPM_PEERS:
            return first, guards.MAX_DISTANCE_OTHER_SCHEME
        apic_task = replace(task, case="standard-apic")
        if apic_task not in self._apic_outcomes:
            self._apic_outcomes[apic_task] = contestants.build_contestant("reference", 1).prepare(apic_task)()
        return self._apic_outcomes[apic_task], guards.MAX_DISTANCE_SAME_SCHEME


def record(task: Task, triangles: int, timing: Timing) -> Record:
    """Return a timing as a JSON object."""
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
        arrays += [np.asarray(outcome.gradient_x), np.asarray(outcome.gradient_youngs)]
    return guards.derivative_violations(arrays)
