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
MIN_SAMPLE_S = 0.2  # shorter runs are repeated within a sample
BYTES_PER_MEBIBYTE = 2**20


class Timing(NamedTuple):
    """Time of one run, over all samples.

    Attributes:
        median: s.
        minimum: s.
        samples: count.
    """

    median: float
    minimum: float
    samples: int

    @classmethod
    def of(cls, samples: list[float]) -> Timing:
        """Summarise samples of seconds per run."""
        return cls(median(samples), min(samples), len(samples))


def sample(run: Callable[[], Result], shortest: float = MIN_SAMPLE_S) -> tuple[float, Result]:
    """Return the seconds per run, repeated for at least ``shortest`` seconds, and the last result."""
    start, count = time.perf_counter(), 0
    while True:
        result, count = run(), count + 1
        elapsed = time.perf_counter() - start
        if elapsed >= shortest:
            return elapsed / count, result


def resident_mebibytes() -> float:
    """Return the present memory of this process [MiB]; where the system does not report it, the peak."""
    return _proc_status("VmRSS")


def peak() -> float:
    """Return the largest memory that this process had so far [MiB]."""
    return _proc_status("VmHWM")


def _proc_status(field: str) -> float:
    """A field of /proc [MiB]; without /proc ``ru_maxrss``, which counts the parent's peak at the fork as well."""
    try:
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith(field + ":"):
                return int(line.split()[1]) / 1024
    except OSError:
        pass
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / BYTES_PER_MEBIBYTE
