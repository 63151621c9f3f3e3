"""Checks of recordings before anything is simulated.

The checks find errors that no model could explain and that would pass as a cause: clocks that jump, streams that do not
overlap, grippers that were swapped, lengths in another unit, clouds that are mirrored or that show something else.
Errors as small as the causes themselves, a camera 4 mm off or a clock 30 ms late, are left to the diagnosis.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...errors import InvalidInput, RecordingError
from ...recordings import Recording, checks, read
from ...recordings.consistency import check_same_cloth, display_name
from ...recordings.reading import EPISODE_FILE
from ...recordings.timing import MAX_FRAME_INTERVAL_S, stream_times
from .cloud_checks import CheckedEpisode, check_handedness, check_positions, check_units

MAX_GAP_INTERVALS = 8.0  # usual intervals between stamps; a longer gap is no dropped frame any more
MAX_GAP_S = 0.2  # a shorter gap is always accepted [s]
REGULAR_FRAMES = 8  # frames on either side of a jump that must be regular
MAX_REGULAR_JITTER = 0.05  # of regular frames, in usual intervals
MIN_PHASE_JUMP = 0.15  # of a clock that was set, in usual intervals
MAX_MISSING_FRACTION = 0.5  # of the frames
MIN_COVERED_FRACTION = 0.5  # of the frames, during the motion
IMAGE_STREAMS = ("depth", "color", "mask")  # of a camera; a diagnosis uses none of them


@dataclass(frozen=True)
class Fault:
    """An error of an episode that makes every answer worthless.

    Attributes:
        episode: name of the episode.
        what: the error, as a sentence.
        remedy: what to do about it.
    """

    episode: str
    what: str
    remedy: str

    def __str__(self) -> str:
        return f"{self.episode}: {self.what}; {self.remedy}"


def check_episodes(recordings: Sequence[Recording]) -> list[Fault]:
    """Return what makes the episodes unusable; an empty list if nothing does.

    Raises:
        InvalidInput: no episodes, episodes of different cloths, or of one cloth with different grasps.
    """
    if not recordings:
        raise InvalidInput("episodes", got="none", expected="one at least")
    check_same_cloth(recordings)
    faults = []
    for k, recording in enumerate(recordings):
        name = display_name(recording, k)
        faults += [Fault(name, what, remedy) for what, remedy in _find_faults(recording)]
    return faults


def read_episodes(folders: Sequence[str | Path]) -> tuple[list[Recording], list[Fault]]:
    """Read episodes from disk; a damaged stream becomes a fault.

    Returns:
        The episodes that could be read, and the faults of the others.

    Raises:
        RecordingError: a folder that is no episode, or one whose description cannot be read.
    """
    recordings, faults = [], []
    for folder in folders:
        try:
            recordings.append(read(folder))
        except RecordingError as error:
            if EPISODE_FILE in error.what or not (Path(folder) / EPISODE_FILE).is_file():
                raise
            got = "" if error.got is None else f", got {error.got}"
            expected = f", expected {error.expected}" if error.expected else ""
            what = f"{error.what}{got}{expected}"
            faults.append(Fault(Path(folder).name, what, error.remedy or "record again"))
    return recordings, faults


def _find_faults(recording: Recording) -> Iterator[tuple[str, str]]:
    """Yield (what, remedy). A fault ends the checks, because it causes faults in the later ones."""
    try:
        faults = list(_check_stamps(recording))
        if not faults:
            episode = CheckedEpisode(recording)
            for check in (_check_overlap, check_units, check_positions, check_handedness):
                if faults := list(check(episode)):
                    break
        yield from faults
    except RecordingError as error:
        yield str(error), "repair or repeat the recording"


def _check_stamps(recording: Recording) -> Iterator[tuple[str, str]]:
    for name, (kind, stamps) in stream_times(recording).items():
        if kind in IMAGE_STREAMS:
            continue
        checks.check_increasing(stamps, f"the stamps of {name}")
        t = _remove_rests(recording, name, stamps)
        intervals = np.diff(t)
        if not len(intervals):
            continue
        usual = float(np.median(intervals))
        if usual > MAX_FRAME_INTERVAL_S:
            yield (
                f"{name} come every {usual:.3g} s: no cloth stays in a motion for so long",
                "stamps are seconds: divide those in milliseconds by 1000 (docs/reference/episode.md)",
            )
            continue
        jump = _find_clock_jump(t, usual)
        longest = int(intervals.argmax()) if jump is None else jump
        if jump is not None or intervals[longest] > max(MAX_GAP_INTERVALS * usual, MAX_GAP_S):
            yield (
                f"the stamps of {name} jump by {intervals[longest]:.3g} s at {stamps[longest]:.3g} s, "
                f"{usual:.3g} s is usual",
                "the clock was set or frames are missing: cut the episode there, or repair the stamps",
            )
        missing = 1 - len(t) / (1 + (t[-1] - t[0]) / usual)
        if missing > MAX_MISSING_FRACTION:
            yield (
                f"{name}: {100 * missing:.0f} % of the frames are missing",
                "record again, or state the rate that was reached",
            )


def _remove_rests(recording: Recording, name: str, t: np.ndarray) -> np.ndarray:
    """Shorten intervals in which a gripper rests: two knots may be any time apart there."""
    if (arm := recording.joints.get(name)) is not None:
        path = arm.q
    elif (gripper := recording.grippers.get(name)) is not None:
        path = np.concatenate([gripper.position, gripper.quat_wxyz], axis=1)
    else:
        return t
    intervals, rests = np.diff(t), (np.diff(path, axis=0) == 0).all(axis=1)
    if rests.all():
        return t[:1]
    intervals = np.where(rests, np.minimum(intervals, np.median(intervals[~rests])), intervals)
    return t[0] + np.concatenate([[0.0], intervals.cumsum()])


def _find_clock_jump(t: np.ndarray, usual: float) -> int | None:
    """Return the interval at which an otherwise regular clock jumps: lost frames leave a whole number of intervals."""
    intervals = np.diff(t)
    for k in np.flatnonzero(np.abs(intervals / usual - 1) > MIN_PHASE_JUMP):
        before, after = t[max(k - REGULAR_FRAMES, 0) : k + 1], t[k + 1 : k + 1 + REGULAR_FRAMES]
        if min(len(before), len(after)) < REGULAR_FRAMES // 2:
            continue
        phases = [(part - part[0]) / usual for part in (before, after)]
        if max(np.abs(p - p.round()).max() for p in phases) > MAX_REGULAR_JITTER:
            continue
        ratio = intervals[k] / usual
        if abs(ratio - round(ratio)) > MIN_PHASE_JUMP:
            return int(k)
    return None


def _check_overlap(episode: CheckedEpisode) -> Iterator[tuple[str, str]]:
    if not episode.paths or not len(episode.t):
        return
    start, end = max(p.t[0] for p in episode.paths.values()), min(p.t[-1] for p in episode.paths.values())
    inside = (episode.t >= start - 1e-6) & (episode.t <= end + 1e-6)
    if not inside[0] or inside.mean() < MIN_COVERED_FRACTION:
        yield (
            f"camera and robot do not overlap: frames from {episode.t[0]:.3g} to {episode.t[-1]:.3g} s, "
            f"motion from {start:.3g} to {end:.3g} s, {100 * inside.mean():.0f} % of the frames inside",
            "bring both onto one clock (clock_offset in episode.json), or cut the frames before the motion begins",
        )
