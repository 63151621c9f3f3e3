"""Checks of a recording before anything is fitted to it, and what can be mended."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ..errors import TorchclothError
from ..recordings import PointClouds, Recording
from ..robots.paths import GripperPath, holding_paths  # pyright: ignore[reportMissingImports] - mapped from robots/
from .lag import estimate_lag
from .patch_noise import check_stated_noise

MIN_CLOCK_PRIOR_STD_S = 0.01  # of a clock that was set by the estimated lag


class CheckedRecording(NamedTuple):
    """A recording after the checks.

    Attributes:
        recording: with what could be mended.
        notes: what was found and done, in sentences; empty where nothing was.
        clock_std: standard error of the clock [s], if the checks have set it; else None.
    """

    recording: Recording
    notes: list[str]
    clock_std: float | None


def check_recording(recording: Recording) -> CheckedRecording:
    """Check for frozen clouds and for a clock that is off, and mend both; name a stated noise that is far off.

    Args:
        recording: an episode.
    """
    name = recording.path.name if recording.path else "recording"
    recording, notes = _leave_out_frozen_clouds(name, recording)
    recording, paths, clock_notes, clock_std = _correct_clock(name, recording)
    stated = check_stated_noise(recording, paths)
    notes += [*clock_notes, *([] if stated is None else [f"{name}: {stated}"])]
    return CheckedRecording(recording, notes, clock_std)


def _correct_clock(
    name: str, recording: Recording
) -> tuple[Recording, dict[str, GripperPath], list[str], float | None]:
    """Return the recording with a clock that is right, the paths of its grippers, notes, and the clock's error [s]."""
    try:
        paths = holding_paths(recording)
        lag = estimate_lag(recording, paths)
    except TorchclothError:  # no paths, so no lag; whoever needs them says so
        paths, lag = {}, None
    if lag is None or not lag.differs_from_recorded:
        return recording, paths, [], None
    note = (
        f"{name}: the observations come {1e3 * lag.value:.0f} ± {1e3 * lag.std:.0f} ms after the motion, and the "
        f"recording says {1e3 * lag.recorded:.0f} ms: the clock was corrected, and its error is fitted"
    )
    # the motion must cover the first frame; what is left is for the fit
    offset = max(-lag.value, max(path.t[0] for path in paths.values()) - _first_frame_time(recording))
    std = math.hypot(max(lag.std, MIN_CLOCK_PRIOR_STD_S), offset + lag.value)
    return replace(recording, clock_offset=offset), paths, [note], std


def _first_frame_time(recording: Recording) -> float:
    """Time of the first cloud, or of the first markers where there are no clouds [s], on the observation's clock."""
    stream = recording.points if recording.points is not None else recording.markers
    return math.inf if stream is None else float(stream.t[0])


def check_all(recordings: Sequence[Recording]) -> tuple[list[Recording], list[str], float | None]:
    """Check several recordings; return them, all notes, and the largest standard error of a clock that was set."""
    checked = [check_recording(recording) for recording in recordings]
    stds = [c.clock_std for c in checked if c.clock_std is not None]
    return [c.recording for c in checked], [note for c in checked for note in c.notes], max(stds, default=None)


def find_frozen_clouds(clouds: PointClouds) -> np.ndarray:
    """Return [T] bool: clouds that equal the one before bit for bit. A sensor's noise never repeats."""
    frames = np.split(clouds.xyz, np.cumsum(clouds.counts)[:-1])
    return np.array([False, *(np.array_equal(a, b) for a, b in pairwise(frames))])


def _leave_out_frozen_clouds(name: str, recording: Recording) -> tuple[Recording, list[str]]:
    points = recording.points
    frozen = np.zeros(0, dtype=bool) if points is None else find_frozen_clouds(points)
    if points is None or not frozen.any() or (~frozen).sum() < 2:
        return recording, []
    note = (
        f"{name}: {frozen.sum()} of {len(points)} clouds equal the one before bit for bit: the camera was frozen, and "
        "they were left out"
    )
    return replace(recording, points=points.select(~frozen)), [note]
