"""What an episode is recognised by, wherever it lies and whatever it is called."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..errors import InvalidInput
from .types import Recording

SAME = 1e-5  # m, between the mean points of one episode, kept and read again


def mark(recording: Recording) -> dict[str, Any]:
    """Name, numbers of frames and points, and their mean [3] m; forces [3] N where nothing was seen."""
    return _mark(recording, *_seen(recording))


def _mark(recording: Recording, frames: int, every: np.ndarray) -> dict[str, Any]:
    name = recording.path.name if recording.path else "recording"
    mean = every.mean(0) if len(every) else np.zeros(3)
    return {"name": name, "frames": frames, "points": max(len(every), 1), "mean": mean.tolist()}


def alike(kept: dict[str, Any], own: dict[str, Any]) -> bool:
    """Whether two marks are of one episode."""
    counts = all(kept[key] == own[key] for key in ("frames", "points"))
    return counts and bool(np.abs(np.subtract(kept["mean"], own["mean"])).max() < SAME)


def each_once(recordings: Sequence[Recording]) -> None:
    """One episode twice is no repetition, and no more evidence than once: it would only shrink the error bars.

    Raises:
        InvalidInput: one is given twice.
    """
    known: list[tuple[dict[str, Any], np.ndarray]] = []
    for recording in recordings:
        frames, every = _seen(recording)
        own = _mark(recording, frames, every)
        # repetitions of one motion may have one mean, not the same noise
        same = (other for other, old in known if alike(other, own) and np.allclose(old, every, rtol=0, atol=SAME))
        if (first := next(same, None)) is not None:
            one = first["name"] == own["name"]
            raise InvalidInput(
                "episodes",
                got=f"{own['name']!r} twice" if one else f"{first['name']!r} and {own['name']!r}, which hold the same",
                expected="each once",
                remedy="leave one out, or record another",
            )
        if len(every):
            known.append((own, every))


def positions(recording: Recording) -> list[np.ndarray]:
    """[N, 3] m each: points, and markers where they were seen."""
    streams = [stream.xyz for stream in (recording.points, recording.markers) if stream is not None]
    return [xyz[np.isfinite(xyz).all(-1)] for xyz in streams]


def _seen(recording: Recording) -> tuple[int, np.ndarray]:
    """Frames, and all that was seen in them [N, 3] m; else the forces [N, 3] N."""
    seen = positions(recording)
    frames = sum(len(stream.t) for stream in (recording.points, recording.markers) if stream is not None)
    if not seen:
        motions = (*recording.grippers.values(), *recording.joints.values())
        seen = [motion.force for motion in motions if motion.force is not None]
        frames = sum(map(len, seen))
    every = np.concatenate(seen) if seen else np.zeros((0, 3))
    return frames, every[np.isfinite(every).all(-1)]
