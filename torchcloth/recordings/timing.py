"""When each stream of an episode ticks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .types import Recording

SLOWEST = 3.0  # s between frames of what moves: 240 Hz in milliseconds are 4
GAP = 1.5  # an interval longer than so many usual ones is a gap


@dataclass(frozen=True)
class Stream:
    """The times of one stream, in s on its own clock.

    Attributes:
        kind: "motion", "joints", "points", "markers", "depth", "color" or "mask".
        frames: how many.
        start, span: first time, and from there to the last.
        rate: Hz, intervals per span.
        largest_gap: the longest interval.
        gaps: how many intervals are longer than 1.5 usual (median) ones.
        jitter: standard deviation of the intervals.
    """

    kind: str
    frames: int
    start: float
    span: float
    rate: float
    largest_gap: float
    gaps: int
    jitter: float


def times(recording: Recording) -> dict[str, tuple[str, np.ndarray]]:
    """Kind and times [T] s of every stream by name; motion runs on the motion clock, all else on the observation's."""
    found: dict[str, tuple[str, np.ndarray]] = {}
    for name in sorted({*recording.grippers, *recording.joints}):
        motion = recording.joints.get(name) or recording.grippers[name]
        kinds = [kind for kind, bag in (("motion", recording.grippers), ("joints", recording.joints)) if name in bag]
        found[name] = (" + ".join(kinds), motion.t)
    for kind in ("points", "markers"):
        if (stream := getattr(recording, kind)) is not None:
            found[kind] = (kind, stream.t)
    for name, camera in recording.cameras.items():
        for kind in ("depth", "color", "mask"):
            if (images := getattr(camera, kind)) is not None:
                found[f"{name}/{kind}"] = (kind, images.t)
    return found


def ticks(kind: str, t: np.ndarray) -> Stream:
    """How a stream ticks."""
    between = np.diff(t)
    span = float(t[-1] - t[0])
    if len(between) == 0:
        return Stream(kind, len(t), float(t[0]), 0.0, 0.0, 0.0, 0, 0.0)
    late = between > GAP * np.median(between)
    rate = len(between) / span
    return Stream(kind, len(t), float(t[0]), span, rate, float(between.max()), int(late.sum()), float(between.std()))
