"""A study on disk: every finished run is a file, so that it can be stopped at any time, continued and extended."""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from torchcloth._utils.files import write_atomically
from torchcloth.errors import InvalidInput, TorchclothError

from ..resumable import check_settings, unreadable, write_settings
from .measures import WITHOUT
from .scenes import Run, Scene, Setup, Variant

TRIANGLES_AT_ONCE = 6000  # of all runs that one process simulates together; fewer leave it idle, more leave the cache
Name = tuple[str, str]  # of a scene: garment, action


class Study(NamedTuple):
    """Where runs are kept; nothing is written before ``begin``."""

    folder: Path
    setup: Setup

    def check(self) -> None:
        """Raises InvalidInput where the folder cannot hold this study's runs."""
        check_settings(self.folder, asdict(self.setup))

    def begin(self) -> None:
        """Make the folder and note the settings."""
        write_settings(self.folder, asdict(self.setup))
        (self.folder / "runs").mkdir(exist_ok=True)

    def path(self, scene: Name, variant: Variant) -> Path:
        """The file of a run."""
        return self.folder / "runs" / f"{'-'.join(scene)}-{variant.name}.npz"

    def has(self, scene: Name, variant: Variant) -> bool:
        """Whether a run is finished."""
        return self.path(scene, variant).exists()

    def write(self, scene: Name, variant: Variant, run: Run) -> None:
        """Keep a finished run; a crash leaves no half file."""
        arrays: dict[str, Any] = {"t": run.t, "x": run.x, **run.energy}
        with write_atomically(self.path(scene, variant)) as part:
            np.savez(part, **arrays)

    def read(self, scene: Name, variant: Variant) -> Run:
        """A finished run.

        Raises:
            RecordingError: the file is damaged.
        """
        path = self.path(scene, variant)
        try:
            with np.load(path) as found:
                return Run(found["t"], found["x"], {key: found[key] for key in ("total", *WITHOUT)})
        except (ValueError, KeyError, EOFError, zipfile.BadZipFile):
            raise unreadable(path) from None


class Task(NamedTuple):
    """Runs of one scene that are simulated together."""

    scene: Name
    variants: list[Variant]

    def work(self, study: Study) -> Iterator[float]:
        """Simulate and keep the runs; yields the share done."""
        try:
            for share, runs in Scene(study.setup, *self.scene).simulate(self.variants):
                for variant, run in zip(self.variants, runs, strict=False):
                    study.write(self.scene, variant, run)
                yield share
        except TorchclothError as error:
            names = ", ".join(variant.name for variant in self.variants)
            raise TorchclothError(f"{' '.join(self.scene)} ({names}): {error}") from error


def missing(study: Study, scenes: list[Name], variants: list[Variant], batch: int | None = None) -> list[Task]:
    """What is still to be simulated, in batches; references first, so that a partial study can be read."""
    size = batch or max(1, TRIANGLES_AT_ONCE // study.setup.triangles)
    tasks = []
    for scene in scenes:
        left = [variant for variant in variants if not study.has(scene, variant)]
        tasks += [Task(scene, left[i : i + size]) for i in range(0, len(left), size)]
    return sorted(tasks, key=lambda task: variants.index(task.variants[0]))


def simulate(study: Study, tasks: list[Task], jobs: int, report: Callable[[float, Task], None]) -> None:
    """Do all tasks, in ``jobs`` processes; ``report`` hears the number of tasks done (with fractions) and the last.

    Raises:
        TorchclothError: the first failure; the other finished runs are kept.
    """
    study.begin()
    if jobs == 1:
        for done, task in enumerate(tasks):
            for share in task.work(study):
                report(done + share, task)
        return
    pool = ProcessPoolExecutor(min(jobs, len(tasks) or 1), get_context("spawn"), initializer=_prepare)
    try:
        pending = {pool.submit(_work, study, task): task for task in tasks}
        for done, future in enumerate(as_completed(pending)):
            try:
                future.result()
            except BrokenProcessPool:
                raise InvalidInput(
                    "--jobs", got=f"{jobs}, and the system ended one of them", expected="as many as there is memory for"
                ) from None
            report(done + 1.0, pending[future])
    finally:
        pool.shutdown(cancel_futures=True)


def _prepare() -> None:
    """A worker: one thread, the default floats of the study, quiet when the terminal interrupts."""
    import signal

    signal.signal(signal.SIGINT, signal.SIG_DFL)
    torch.set_num_threads(1)
    torch.set_default_dtype(torch.float64)


def _work(study: Study, task: Task) -> None:
    for _ in task.work(study):
        pass
