"""Before anything is simulated: can these episodes be believed?

What is looked for is what no model could mend and what would pass as a cause: clocks that jump, streams that do not
overlap, grippers that were swapped, lengths in another unit, clouds that are mirrored or of something else. An error
of the size that is among the causes, a camera 4 mm off or a clock 30 ms late, is none of it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...errors import InvalidInput, RecordingError
from ...recordings import Recording, checks, read
from ...recordings.consistency import name_of, same_cloth
from ...recordings.reading import EPISODE
from ...recordings.timing import SLOWEST, times
from .cloud_checks import CheckedEpisode, check_handedness, check_positions, check_units

JUMP, LEAST_JUMP = 8.0, 0.2  # usual intervals and s: a longer one is no dropped frame any more
TICKS, EVEN, BEAT = 8, 0.05, 0.15  # frames to either side that tick evenly; usual intervals, of a tick and of a jump
DROPPED = 0.5  # share of the frames
COVERED = 0.5  # share of the frames that the motion must cover
IMAGES = ("depth", "color", "mask")  # streams of a camera, which nothing here is compared with


@dataclass(frozen=True)
class Fault:
    """Something about an episode that makes every answer worthless.

    Attributes:
        episode: its name.
        what: a plain sentence.
        remedy: what to do about it.
    """

    episode: str
    what: str
    remedy: str

    def __str__(self) -> str:
        return f"{self.episode}: {self.what}; {self.remedy}"


def check_episodes(recordings: Sequence[Recording]) -> list[Fault]:
    """What makes these episodes unusable; empty where nothing does.

    Raises:
        InvalidInput: there are none, or they are of different cloths, or of one that is held elsewhere.
    """
    if not recordings:
        raise InvalidInput("episodes", got="none", expected="one at least")
    same_cloth(recordings)
    found = []
    for k, recording in enumerate(recordings):
        name = name_of(recording, k)
        found += [Fault(name, what, remedy) for what, remedy in _faults(recording)]
    return found


def read_episodes(folders: Sequence[str | Path]) -> tuple[list[Recording], list[Fault]]:
    """Episodes from disk, and what is wrong with the streams of those that cannot be read.

    Raises:
        RecordingError: a folder that is no episode, or one whose description cannot be read.
    """
    found, faults = [], []
    for folder in folders:
        try:
            found.append(read(folder))
        except RecordingError as error:
            if EPISODE in error.what or not (Path(folder) / EPISODE).is_file():
                raise
            got = "" if error.got is None else f", got {error.got}"
            expected = f", expected {error.expected}" if error.expected else ""
            what = f"{error.what}{got}{expected}"
            faults.append(Fault(Path(folder).name, what, error.remedy or "record again"))
    return found, faults


def _faults(recording: Recording) -> Iterator[tuple[str, str]]:
    """(what, remedy); a fault hides those that it would cause."""
    try:
        yield from (found := list(_stamps(recording)))
        if not found:
            seen = CheckedEpisode(recording)
            yield from next((found for kind in (_overlap, check_units, check_positions, check_handedness) if (found := list(kind(seen)))), [])
    except RecordingError as error:
        yield str(error), "repair or repeat the recording"


def _stamps(recording: Recording) -> Iterator[tuple[str, str]]:
    for name, (kind, stamps) in times(recording).items():
        if kind in IMAGES:
            continue
        checks.increasing(stamps, f"the stamps of {name}")
        t = _without_rests(recording, name, stamps)
        between = np.diff(t)
        if not len(between):
            continue
        usual = float(np.median(between))
        if usual > SLOWEST:
            yield (
                f"{name} come every {usual:.3g} s: no cloth stays in a motion for so long",
                "stamps are seconds: divide those in milliseconds by 1000 (docs/reference/episode.md)",
            )
            continue
        jump = _set_clock(t, usual)
        worst = int(between.argmax()) if jump is None else jump
        if jump is not None or between[worst] > max(JUMP * usual, LEAST_JUMP):
            yield (
                f"the stamps of {name} jump by {between[worst]:.3g} s at {stamps[worst]:.3g} s, {usual:.3g} s is usual",
                "the clock was set or frames are missing: cut the episode there, or repair the stamps",
            )
        missing = 1 - len(t) / (1 + (t[-1] - t[0]) / usual)
        if missing > DROPPED:
            yield (
                f"{name}: {100 * missing:.0f} % of the frames are missing",
                "record again, or state a rate that was kept",
            )


def _without_rests(recording: Recording, name: str, t: np.ndarray) -> np.ndarray:
    """Stamps of a stream; between two knots of a gripper that rests there may be any time, which is taken out."""
    if (arm := recording.joints.get(name)) is not None:
        path = arm.q
    elif (gripper := recording.grippers.get(name)) is not None:
        path = np.concatenate([gripper.position, gripper.quat_wxyz], axis=1)
    else:
        return t
    between, rests = np.diff(t), (np.diff(path, axis=0) == 0).all(axis=1)
    if rests.all():
        return t[:1]
    between = np.where(rests, np.minimum(between, np.median(between[~rests])), between)
    return t[0] + np.concatenate([[0.0], between.cumsum()])


def _set_clock(t: np.ndarray, usual: float) -> int | None:
    """The interval at which a clock that otherwise ticks evenly jumps: lost frames leave a whole number of ticks."""
    between = np.diff(t)
    for k in np.flatnonzero(np.abs(between / usual - 1) > BEAT):
        before, after = t[max(k - TICKS, 0) : k + 1], t[k + 1 : k + 1 + TICKS]
        if min(len(before), len(after)) < TICKS // 2:
            continue
        beats = [(part - part[0]) / usual for part in (before, after)]
        if max(np.abs(b - b.round()).max() for b in beats) > EVEN:
            continue
        ticks = between[k] / usual
        if abs(ticks - round(ticks)) > BEAT:
            return int(k)
    return None


def _overlap(seen: CheckedEpisode) -> Iterator[tuple[str, str]]:
    if not seen.paths or not len(seen.t):
        return
    start, end = max(p.t[0] for p in seen.paths.values()), min(p.t[-1] for p in seen.paths.values())
    inside = (seen.t >= start - 1e-6) & (seen.t <= end + 1e-6)
    if not inside[0] or inside.mean() < COVERED:
        yield (
            f"camera and robot do not overlap: frames from {seen.t[0]:.3g} to {seen.t[-1]:.3g} s, "
            f"motion from {start:.3g} to {end:.3g} s, {100 * inside.mean():.0f} % of the frames inside",
            "bring both onto one clock (clock_offset in episode.json), or cut the frames before the motion begins",
        )
