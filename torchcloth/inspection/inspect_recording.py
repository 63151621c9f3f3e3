"""An episode looked at: streams, clocks, noise, frames."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from ..errors import MissingDependency, TorchclothError
from ..recordings import Recording, size_checks, timing
from ..recordings.timing import Stream
from ..robots.paths import GripperPath, holding_paths, gripper_paths  # pyright: ignore[reportMissingImports] - mapped from robots/
from . import depth_images, frame_checks, noise
from .depth_images import Depth
from .frame_checks import Frames
from .lag import CANNOT, Lag, lag
from .noise import Noise

CONVENTION = (
    "SI units. Times on each stream's own clock. lag: observation stamps minus motion stamps of the same event (the "
    "recording's clock_offset should be minus the lag); std by jackknife over stretches. noise: one standard deviation "
    "of a coordinate. rejected: frames whose lengths differ from the cloth's by more than 10 %. coverage: share of the "
    "markers seen, or area seen over the cloth's area (both sides of a fold count, a side that is not seen "
    "does not; to about 20 %, so it may exceed 1)."
)


@dataclass(frozen=True, eq=False)
class Inspection:
    """What `inspect` found.

    Attributes:
        recording: what was looked at.
        streams: by name.
        paths: of the grippers, by name.
        lag: between observations and motion; None without either.
        noise, frames: of "points" and "markers", where present.
        depth: of cameras with depth images.
        notes: what could not be done, and what to mistrust.
    """

    recording: Recording = field(repr=False)
    streams: dict[str, Stream]
    paths: dict[str, GripperPath] = field(repr=False)
    lag: Lag | None
    noise: dict[str, Noise]
    frames: dict[str, Frames]
    depth: dict[str, Depth]
    notes: list[str]

    def as_dict(self) -> dict[str, Any]:
        """The content of inspection.json."""
        curve = None
        if self.lag is not None:
            told = {key: getattr(self.lag, key) for key in ("value", "std", "told", "stated", "misfit")}
            curve = {**told, "cannot_tell": CANNOT}
        whole = {
            "episode": None if self.recording.path is None else str(self.recording.path),
            "streams": {name: asdict(s) for name, s in self.streams.items()},
            "lag": curve,
            "noise": {name: asdict(n) for name, n in self.noise.items()},
            "frames": {name: _frames(f) for name, f in self.frames.items()},
            "depth": {name: asdict(d) for name, d in self.depth.items()},
            "convention": CONVENTION,
            "notes": self.notes,
        }
        return _plain(whole)


def _moved(recording: Recording, holds: dict[str, GripperPath]) -> tuple[dict[str, GripperPath], list[str]]:
    """(the paths of those that hold the cloth and of others that are known, why others are not there)."""
    found, notes = dict(holds), []
    for name in sorted({*recording.grippers, *recording.joints} - holds.keys()) if holds else []:
        try:
            found |= gripper_paths(recording, [name])
        except TorchclothError as error:
            notes.append(f"{name!r} stands by and has no path: {error}")
    return found, notes


def inspect(recording: Recording) -> Inspection:
    """Look at an episode.

    Args:
        recording: read by `recordings.read`.

    Raises:
        RecordingError: an image that cannot be decoded.
    """
    notes: list[str] = []
    try:
        holds = holding_paths(recording)  # an arm that stands by tells nothing of the cloth
    except TorchclothError as error:  # joints without an arm that is known here: all else can still be looked at
        holds = {}
        notes.append(f"no gripper paths, so no lag: {error}")
    moved, more = _moved(recording, holds)
    notes += more
    seen: dict[str, Frames] = {}
    if recording.markers is not None:
        seen["markers"] = frame_checks.of_markers(recording.markers, recording.cloth)
    if recording.points is not None:
        held = _held(recording.points.t + recording.clock_offset, holds)
        seen["points"], more = frame_checks.of_clouds(recording.points, recording.cloth, held)
        notes += more
    late = lag(recording, holds, {name: ~found.rejected for name, found in seen.items()})
    shift = -recording.clock_offset if late is None else late.trusted
    depth = {}
    for name, camera in recording.cameras.items():
        try:
            if (found := depth_images.depth_of(camera)) is not None:
                depth[name] = found
        except MissingDependency as error:
            notes.append(f"{name}: {error}")
    return Inspection(
        recording,
        {name: timing.ticks(kind, t) for name, (kind, t) in timing.times(recording).items()},
        moved,
        late,
        _noises(recording, holds, seen, shift),
        seen,
        depth,
        notes + _remarks(recording, holds, late),
    )


def _held(t: np.ndarray, holds: dict[str, GripperPath]) -> np.ndarray:
    """[T, G, 3] m, where the grippers that hold are at times on the motion clock."""
    return np.stack([path.at(t)[0] for path in holds.values()], 1) if holds else np.zeros((len(t), 0, 3))


def _noises(recording: Recording, holds: dict[str, GripperPath], seen: dict[str, Frames], shift: float) -> dict[str, Noise]:
    def still(t: np.ndarray) -> np.ndarray:
        return np.all([path.is_standing(t - shift) for path in holds.values()], axis=0) if holds else np.zeros(len(t), bool)

    found = {}
    if (markers := recording.markers) is not None:
        found["markers"] = noise.of_markers(markers, still(markers.t), ~seen["markers"].rejected)
    if (points := recording.points) is not None:
        found["points"] = noise.of_clouds(points, still(points.t) if holds else None)
    return {name: value for name, value in found.items() if value is not None}


def _remarks(recording: Recording, holds: dict[str, GripperPath], late: Lag | None) -> list[str]:
    """What a person should do about it."""
    remarks = []
    if late is None and holds:
        remarks.append("no lag: too few observed frames")
    if late is not None and not late.told:
        remarks.append(f"the recording does not tell a lag: {CANNOT}")
    elif late is not None and late.differs:
        remarks.append(
            f"the clocks differ: observations come {late.value:.3f} s late, the recording says {late.stated:.3f} s; "
            f"set clock_offset to {-late.value:.3f} if the stamps are to blame"
        )
    if (found := size_checks.of_another_size(recording)) is not None:
        remarks.append("; ".join(found))
    if recording.points is None and recording.markers is None:
        remarks.append("no points and no markers: nothing to compare a simulation with")
    return remarks


def _frames(found: Frames) -> dict[str, Any]:
    return {
        "rejected": np.flatnonzero(found.rejected),
        "rejected_share": found.rejected.mean(),
        "why": found.why,
        "coverage": found.coverage,
        "removed": found.removed,
        "cuts": found.cuts,
    }


def _plain(value: Any) -> Any:
    """Lists and numbers that JSON can hold; NaN becomes null."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not np.isfinite(value) else value
