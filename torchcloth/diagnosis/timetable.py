"""How much of a diagnosis is done, and how long the rest will take.

The unit of work is a pass: one simulation of every episode with its slopes. It is measured as soon as the first episode
is done, and again with each pass. The passes of a stage are those of diagnoses of small episodes. How many causes will
be tried is not known before, so the rest may take half or twice as long.
"""

from __future__ import annotations

import os
import re
import time
from collections import deque
from collections.abc import Callable, Sequence

from .._utils.durations import describe_time
from .data.dataset import Progress

FIRST_PASS_WORK = 1.8  # passes; the first one has slopes along the nuisances as well
CAUSES_PASS_WORK = 2.2  # passes; one with slopes along all causes
WARM_START_WORK, BASE_MODEL_WORK, BIFURCATION_WORK = 3.0, 5.5, 1.5  # passes
SEARCH_WORK = 26.0  # passes: 20 where a cause is found, 37 where many are tried and refused
REST_OF_SEARCH = {"with ": 7.0, "without ": 2.0}  # passes, once a cause was accepted, or is tried to be dropped
LAWS_WORK, PICTURES_WORK = 7.0, 0.3  # passes
MISSING_FORCE_WORK, MISSING_FORCE_SHARE = 2.5, 0.5  # passes, and how often several motions ask for it
EXPERIMENT_WORK, EXPERIMENT_SHARE = 10.0, 0.4  # passes of one episode, and how often several motions ask for one
EXPERIMENT_S = 1.6  # mean duration of an experiment
MIN_DURATION_S = 1e-3
MEASURED_PASSES = 8  # the last ones, of which the mean is taken: those that were stored take no time
MIN_STAGE_REST = 0.15  # of a stage that takes longer than planned, in units of what is done of it
STAGES = (
    "from the data sheet", "base model", "bifurcating bins", "search", "missing force", "force laws", "next experiment",
    "pictures",
)  # fmt: skip
CAUSES_LINE = re.compile(r"\d+ causes: |, causes: |the other way: ")
POSITION = re.compile(r", (\d+) of (\d+)")
REST_OF_PASS = re.compile(r", \d+ s left$")


class Timetable:
    """Estimate of the time that a diagnosis takes.

    Args:
        durations: [E] s, of the episodes.
        has_held_out_motions: whether causes are searched for.
        clock: returns the time [s].
    """

    def __init__(
        self, durations: Sequence[float], has_held_out_motions: bool, clock: Callable[[], float] = time.monotonic
    ) -> None:
        mean, count = sum(durations) / len(durations), len(durations)
        experiment = EXPERIMENT_WORK * EXPERIMENT_S / (max(mean, MIN_DURATION_S) * count)
        several = has_held_out_motions
        works = (
            WARM_START_WORK, BASE_MODEL_WORK, BIFURCATION_WORK, SEARCH_WORK if several else 0.0,
            MISSING_FORCE_WORK * (MISSING_FORCE_SHARE if several else 1.0), 0.0,
            experiment * (EXPERIMENT_SHARE if several else 1.0), PICTURES_WORK,
        )  # fmt: skip
        self._planned = dict(zip(STAGES, works, strict=True))
        self._expected_if_begun = self._planned | {
            "search": SEARCH_WORK,
            "force laws": LAWS_WORK,
            "missing force": MISSING_FORCE_WORK,
            "next experiment": experiment,
        }
        self._count, self._first_share = count, durations[0] / max(sum(durations), MIN_DURATION_S)
        self._clock, self._stage = clock, -1
        self._begin = clock()
        self._pass_begin, self._work_of_pass, self._done, self._lines = self._begin, 0.0, 0.0, 0
        self._passes: deque[tuple[float, float]] = deque(maxlen=MEASURED_PASSES)  # s, and passes that they are worth
        self._pass_s: float | None = None
        self._cores, self._experiments_done = os.cpu_count() or 1, 0.0

    def wrap(self, progress: Progress) -> Progress:
        """Return a callback that adds share and time left to each line."""

        def report(text: str) -> None:
            self._advance(text)
            rest = self.time_left()
            text = REST_OF_PASS.sub("", text)
            if rest is None:
                progress(text)
                return
            elapsed = self._clock() - self._begin
            progress(f"{text}; {100 * elapsed / max(elapsed + rest, 1e-9):.0f} % done, {describe_time(rest)} left")

        return report

    def time_left(self) -> float | None:
        """Return the time left [s]; None until the first episode has been simulated."""
        if self._pass_s is None:
            return None
        done = self._done + (self._clock() - self._pass_begin) / max(self._pass_s, 1e-9)
        here = max(self._planned[STAGES[max(self._stage, 0)]] - done, MIN_STAGE_REST * done)
        if self._experiments_done:
            here = done * (1 / self._experiments_done - 1)
        return self._pass_s * (here + sum(self._planned[name] for name in STAGES[self._stage + 1 :]))

    def _advance(self, text: str) -> None:
        """Take note of a line: of its stage, and of what the lines before took."""
        now, stage = self._clock(), max(_find_stage(text), self._stage)
        numbers = POSITION.search(text)
        is_experiment = STAGES[stage] == "next experiment"
        is_pass = numbers is not None and numbers[1] == "1" and not is_experiment
        if self._work_of_pass and (is_pass or stage != self._stage):
            self._passes.append((now - self._pass_begin, self._work_of_pass))
            seconds, work = map(sum, zip(*self._passes, strict=True))
            self._done += self._work_of_pass
            self._pass_s, self._pass_begin, self._work_of_pass = seconds / work, now, 0.0
        elif self._lines == 1:  # as many episodes as there are cores run at once
            at_once = min(self._cores, self._count)
            self._pass_s = (now - self._pass_begin) / (FIRST_PASS_WORK * at_once * self._first_share)
        if stage != self._stage:
            self._stage, self._done, self._pass_begin, self._experiments_done = stage, 0.0, now, 0.0
            self._planned[STAGES[stage]] = self._expected_if_begun[STAGES[stage]]
        if STAGES[stage] == "search":
            rest = next((rest for prefix, rest in REST_OF_SEARCH.items() if text.startswith(prefix)), SEARCH_WORK)
            self._done = max(self._done, SEARCH_WORK - rest)
        if is_experiment and numbers is not None:
            # this one begins as another ends, and the others that run are half done
            ended = int(numbers[1]) - (self._cores + 1) / 2
            self._experiments_done = max(ended / int(numbers[2]), 0.0) if int(numbers[1]) > self._cores else 0.0
        if is_pass:
            self._pass_begin, self._work_of_pass = now, self._find_work(text)
        self._lines += 1

    def _find_work(self, text: str) -> float:
        """Return the passes that the pass of a line is worth."""
        if not self._lines:
            return FIRST_PASS_WORK
        if _find_stage(text) == STAGES.index("bifurcating bins"):
            return BIFURCATION_WORK
        return CAUSES_PASS_WORK if CAUSES_LINE.search(text) else 1.0


def _find_stage(text: str) -> int:
    """Return the index of a line's stage; what has no name of its own belongs to the search."""
    name = text.partition(":")[0]
    return STAGES.index(name if name in STAGES else "search")
