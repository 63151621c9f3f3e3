"""Durations in words, and the time that iterations take at most."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable

SHOWN_S_STEP = 5  # s, to which short times are rounded
MAX_SHOWN_S, MAX_SHOWN_MIN = 90.0, 90.0  # longer times are shown in minutes, and in hours
MEASURED_ITERATIONS = 5  # the last ones, of which the mean is taken


def describe_time(seconds: float) -> str:
    """Return a time in words, as roughly as it is known."""
    if seconds < MAX_SHOWN_S:
        return f"about {max(SHOWN_S_STEP, SHOWN_S_STEP * round(seconds / SHOWN_S_STEP))} s"
    return f"about {seconds / 60:.0f} min" if seconds < 60 * MAX_SHOWN_MIN else f"about {seconds / 3600:.1f} h"


class IterationTimer:
    """Upper bound of the time that a search takes, from the time of its iterations.

    Args:
        max_iterations: largest number of iterations on all of the data.
        clock: returns the time [s].
    """

    def __init__(self, max_iterations: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._max_iterations, self._clock = max_iterations, clock
        self._seconds: deque[float] = deque(maxlen=MEASURED_ITERATIONS)  # of an iteration on all of the data
        self._last: tuple[float, int] | None = None
        self._done = 0

    def describe(self, iteration: int, fraction: float = 1.0) -> str:
        """Return the time left at most, in words; empty until an iteration has been measured.

        Args:
            iteration: number of the iteration that ended; equal to the last one if nothing was simulated for it.
            fraction: of the data that it used, to which its time is proportional.
        """
        now = self._clock()
        if self._last is not None and iteration > self._last[1]:
            count = iteration - self._last[1]
            self._seconds.append((now - self._last[0]) / (count * fraction))
            self._done += count if fraction == 1.0 else 0
        self._last = (now, iteration)
        if not self._seconds:
            return ""
        left = max(self._max_iterations - self._done, 0) * sum(self._seconds) / len(self._seconds)
        return f"at most {describe_time(left)} left"
