"""Time and memory of one process."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import NamedTuple, TypeVar

Result = TypeVar("Result")
SHORTEST = 0.2  # s, of one sample: shorter runs are repeated within it
MEBI = 2**20


class Timing(NamedTuple):
    """Of one run, over all samples."""

    median: float  # s
    minimum: float  # s
    samples: int

    @classmethod
    def of(cls, samples: list[float]) -> Timing:
        """From seconds per run."""
        return cls(median(samples), min(samples), len(samples))


def sample(run: Callable[[], Result], shortest: float = SHORTEST) -> tuple[float, Result]:
    """Seconds per run, repeated until ``shortest`` seconds have passed, and what the last one returned."""
    start, count = time.perf_counter(), 0
    while True:
        result, count = run(), count + 1
        elapsed = time.perf_counter() - start
        if elapsed >= shortest:
            return elapsed / count, result


def resident() -> float:
    """Memory of this process now [MiB]; where the system does not say, its peak."""
    return _status("VmRSS")


def peak() -> float:
    """Largest memory that this process ever had [MiB]."""
    return _status("VmHWM")


def _status(field: str) -> float:
    """``ru_maxrss`` would count the parent's peak at the fork as well: only for systems without /proc."""
    try:
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith(field + ":"):
                return int(line.split()[1]) / 1024
    except OSError:
        pass
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / MEBI
