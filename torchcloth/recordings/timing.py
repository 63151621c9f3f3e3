"""Timing of the streams of an episode."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .types import Recording

MAX_FRAME_INTERVAL_S = 3.0  # between frames of a moving scene; 240 Hz in milliseconds are 4
GAP_FACTOR = 1.5  # a gap is longer than so many median intervals


@dataclass(frozen=True)
class StreamTiming:
    """Timing of one stream, in s on its own clock.

    Attributes:
        kind: "motion", "joints", "points", "markers", "depth", "color" or "mask".
        frames: number of frames.
        start: time of the first frame.
        span: time from the first to the last frame.
        rate: Hz, intervals per span.
        largest_gap: the longest interval.
        gaps: number of intervals that are longer than 1.5 median ones.
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


def stream_times(recording: Recording) -> dict[str, tuple[str, np.ndarray]]:
    """Return kind and times [T] s of every stream by name.

    Motion runs on the motion clock, all other streams on that of the observation.
    """
    streams: dict[str, tuple[str, np.ndarray]] = {}
    for name in sorted({*recording.grippers, *recording.joints}):
        motion = recording.joints.get(name) or recording.grippers[name]
        kinds = [kind for kind, bag in (("motion", recording.grippers), ("joints", recording.joints)) if name in bag]
        streams[name] = (" + ".join(kinds), motion.t)
    for kind in ("points", "markers"):
        if (stream := getattr(recording, kind)) is not None:
            streams[kind] = (kind, stream.t)
    for name, camera in recording.cameras.items():
        for kind in ("depth", "color", "mask"):
            if (images := getattr(camera, kind)) is not None:
                streams[f"{name}/{kind}"] = (kind, images.t)
    return streams


def summarise_timing(kind: str, t: np.ndarray) -> StreamTiming:
    """Return the timing of a stream with times ``t`` [T] s."""
    between = np.diff(t)
    span = float(t[-1] - t[0])
    if len(between) == 0:
        return StreamTiming(kind, len(t), float(t[0]), 0.0, 0.0, 0.0, 0, 0.0)
    late = between > GAP_FACTOR * np.median(between)
    rate = len(between) / span
    return StreamTiming(
        kind, len(t), float(t[0]), span, rate, float(between.max()), int(late.sum()), float(between.std())
    )
