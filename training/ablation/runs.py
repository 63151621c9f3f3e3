"""The ablation on disk: each finished run is a file, see ``ResumableStudy``."""

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

from ..resumable import ResumableStudy, damaged_file_error
from .measures import LEFT_OUT_TERMS
from .scenes import Run, Scene, Setup, Variant

TRIANGLES_PER_BATCH = 6000  # of all runs that one process simulates together; fewer idle, more exceed the cache
SceneName = tuple[str, str]  # garment, action


class AblationStudy(ResumableStudy):
    """Runs of an ablation, one NPZ file for each.

    Args:
        folder: see ``ResumableStudy``.
        setup: what all runs share.

    Raises:
        InvalidInput: see ``ResumableStudy``.
    """

    def __init__(self, folder: Path, setup: Setup) -> None:
        super().__init__(folder, asdict(setup))
        self.setup = setup

    def start(self) -> None:
        """Write the settings, if they are not there yet, and make the folder of the runs."""
        super().start()
        (self.folder / "runs").mkdir(exist_ok=True)

    def path(self, scene: SceneName, variant: Variant) -> Path:
        """Return the file of a run."""
        return self.folder / "runs" / f"{'-'.join(scene)}-{variant.name}.npz"

    def has_run(self, scene: SceneName, variant: Variant) -> bool:
        """Tell whether a run is finished."""
        return self.path(scene, variant).exists()

    def save_run(self, scene: SceneName, variant: Variant, run: Run) -> None:
        """Write a finished run atomically."""
        arrays: dict[str, Any] = {"t": run.t, "x": run.x, **run.energy}
        with write_atomically(self.path(scene, variant)) as file:
            np.savez(file, **arrays)

    def load_run(self, scene: SceneName, variant: Variant) -> Run:
        """Return a finished run.

        Raises:
            RecordingError: the file is damaged.
        """
        path = self.path(scene, variant)
        try:
            with np.load(path) as stored:
                return Run(stored["t"], stored["x"], {key: stored[key] for key in ("total", *LEFT_OUT_TERMS)})
        except (ValueError, KeyError, EOFError, zipfile.BadZipFile):
            raise damaged_file_error(path) from None


class Batch(NamedTuple):
    """Runs of one scene that are simulated together.

    Attributes:
        scene: garment and action.
        variants: of the scene.
    """

    scene: SceneName
    variants: list[Variant]

    def simulate(self, study: AblationStudy) -> Iterator[float]:
        """Simulate and save the runs; yields the fraction done."""
        try:
            for fraction, runs in Scene(study.setup, *self.scene).simulate(self.variants):
                for variant, run in zip(self.variants, runs, strict=False):
                    study.save_run(self.scene, variant, run)
                yield fraction
        except TorchclothError as error:
            names = ", ".join(variant.name for variant in self.variants)
            raise TorchclothError(f"{' '.join(self.scene)} ({names}): {error}") from error


def plan_batches(
    study: AblationStudy, scenes: list[SceneName], variants: list[Variant], batch: int | None = None
) -> list[Batch]:
    """Return the missing runs in batches, references first, so that a partial study can be reported."""
    size = batch or max(1, TRIANGLES_PER_BATCH // study.setup.triangles)
    batches: list[Batch] = []
    for scene in scenes:
        plan_batches = [variant for variant in variants if not study.has_run(scene, variant)]
        batches += [Batch(scene, plan_batches[i : i + size]) for i in range(0, len(plan_batches), size)]
    return sorted(batches, key=lambda batch: variants.index(batch.variants[0]))


def simulate_batches(
    study: AblationStudy, batches: list[Batch], jobs: int, report: Callable[[float, Batch], None]
) -> None:
    """Simulate all batches in ``jobs`` processes.

    Args:
        study: to which runs are saved.
        batches: to be simulated.
        jobs: number of processes.
        report: called with the number of batches done, with fractions, and the last batch.

    Raises:
        TorchclothError: the first failure; the other finished runs remain.
    """
    study.start()
    if jobs == 1:
        for done, batch in enumerate(batches):
            for fraction in batch.simulate(study):
                report(done + fraction, batch)
        return
    pool = ProcessPoolExecutor(min(jobs, len(batches) or 1), get_context("spawn"), initializer=_prepare_worker)
    try:
        pending = {pool.submit(_simulate_batch, study, batch): batch for batch in batches}
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


def _prepare_worker() -> None:
    """Set one thread and the study's precision, and stay quiet when the terminal interrupts."""
    import signal

    signal.signal(signal.SIGINT, signal.SIG_DFL)
    torch.set_num_threads(1)
    torch.set_default_dtype(torch.float64)


def _simulate_batch(study: AblationStudy, batch: Batch) -> None:
    for _ in batch.simulate(study):
        pass
