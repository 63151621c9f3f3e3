"""Fingerprints of episodes, independent of their location and name."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..errors import InvalidInput
from .types import Recording

MAX_MEAN_OFFSET_M = 1e-5  # between the mean points of an episode before and after it was stored


def fingerprint(recording: Recording) -> dict[str, Any]:
    """Return name, numbers of frames and points, and mean point [3] m; without points, the mean force [3] N."""
    return _build_fingerprint(recording, *_observed_values(recording))


def _build_fingerprint(recording: Recording, frames: int, values: np.ndarray) -> dict[str, Any]:
    name = recording.path.name if recording.path else "recording"
    mean = values.mean(0) if len(values) else np.zeros(3)
    return {"name": name, "frames": frames, "points": max(len(values), 1), "mean": mean.tolist()}


def same_episode(first: dict[str, Any], second: dict[str, Any]) -> bool:
    """Return whether two fingerprints are of one episode."""
    counts = all(first[key] == second[key] for key in ("frames", "points"))
    return counts and bool(np.abs(np.subtract(first["mean"], second["mean"])).max() < MAX_MEAN_OFFSET_M)


def reject_duplicates(recordings: Sequence[Recording]) -> None:
    """Refuse an episode that is given twice: it is no repetition and would only shrink the error bars.

    Raises:
        InvalidInput: names the episode.
    """
    known: list[tuple[dict[str, Any], np.ndarray]] = []
    for recording in recordings:
        frames, values = _observed_values(recording)
        new = _build_fingerprint(recording, frames, values)
        for old, old_values in known:
            # Repetitions of one motion may have the same mean, but not the same noise.
            if same_episode(old, new) and np.allclose(old_values, values, rtol=0, atol=MAX_MEAN_OFFSET_M):
                names = f"{old['name']!r} and {new['name']!r}, which hold the same"
                raise InvalidInput(
                    "episodes",
                    got=f"{new['name']!r} twice" if old["name"] == new["name"] else names,
                    expected="each once",
                    remedy="leave one out, or record another",
                )
        if len(values):
            known.append((new, values))


def observed_positions(recording: Recording) -> list[np.ndarray]:
    """Return the observed points [N, 3] m of each stream: point clouds, and markers where they were seen."""
    streams = [stream.xyz for stream in (recording.points, recording.markers) if stream is not None]
    return [xyz[np.isfinite(xyz).all(-1)] for xyz in streams]


def _observed_values(recording: Recording) -> tuple[int, np.ndarray]:
    """Number of frames, and all points in them [N, 3] m; without points, the forces [N, 3] N."""
    streams = observed_positions(recording)
    frames = sum(len(stream.t) for stream in (recording.points, recording.markers) if stream is not None)
    if not streams:
        motions = (*recording.grippers.values(), *recording.joints.values())
        streams = [motion.force for motion in motions if motion.force is not None]
        frames = sum(map(len, streams))
    values = np.concatenate(streams) if streams else np.zeros((0, 3))
    return frames, values[np.isfinite(values).all(-1)]
