"""Inspect an episode: streams, clocks, noise and frames."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from ..errors import MissingDependency, TorchclothError
from ..recordings import Recording, size_checks, timing
from ..recordings.timing import StreamTiming
from ..robots.paths import GripperPath, gripper_paths, holding_paths  # pyright: ignore[reportMissingImports] - mapped from robots/
from . import depth_images, frame_checks, noise
from .arm_views import describe_unmodelled_arms
from .corrections import find_frozen_clouds
from .depth_images import DepthSummary
from .frame_checks import FrameChecks
from .lag import LAG_CAVEAT, LagEstimate, estimate_lag
from .noise import NoiseEstimate
from .patch_noise import (
    PatchNoise,
    describe_stated_noise,
    estimate_patch_noise,
    gripper_positions,
    standing_frames,
)

CONVENTION = (
    "SI units. Times are on each stream's own clock. lag: observation stamps minus motion stamps of one event (the "
    "recording's clock_offset should be minus the lag); std: by jackknife over blocks of time. noise: one standard "
    "deviation of a coordinate, independent from point to point. patch_noise: what neighbouring points share besides, "
    "as far as it changes from frame to frame. frozen_clouds: frames whose cloud equals the one before bit for bit. "
    "rejected: frames whose lengths differ from the cloth's by more than 10 %, "
    "and clouds of less than a tenth of the median number of points. coverage: "
    "fraction of the markers seen, or area seen divided by the cloth's area (to about 20 %, so it may exceed 1; both "
    "sides of a fold count, a hidden side does not)."
)
SCHEMA = "torchcloth.inspection/1"


@dataclass(frozen=True, eq=False)
class Inspection:
    """Result of `inspect`.

    Attributes:
        recording: the inspected episode.
        streams: timing of each stream, by name.
        paths: of the grippers, by name.
        lag: of the observations behind the motion; None if either is missing.
        noise: of "points" and "markers", if present.
        patch_noise: the part of the points' noise that neighbouring points share; None without points.
        frozen: [K] indices of clouds that equal the one before bit for bit.
        frames: checks of "points" and "markers", if present.
        depth: summary of each camera with depth images.
        notes: what could not be done, and what to mistrust.
    """

    recording: Recording = field(repr=False)
    streams: dict[str, StreamTiming]
    paths: dict[str, GripperPath] = field(repr=False)
    lag: LagEstimate | None
    noise: dict[str, NoiseEstimate]
    patch_noise: PatchNoise | None
    frozen: list[int]
    frames: dict[str, FrameChecks]
    depth: dict[str, DepthSummary]
    notes: list[str]

    def as_dict(self) -> dict[str, Any]:
        """Return the content of inspection.json."""
        lag = None
        if self.lag is not None:
            keys = ("value", "std", "is_determined", "recorded", "misfit")
            lag = {**{key: getattr(self.lag, key) for key in keys}, "caveat": LAG_CAVEAT}
        content = {
            "schema": SCHEMA,
            "episode": None if self.recording.path is None else str(self.recording.path),
            "streams": {name: asdict(s) for name, s in self.streams.items()},
            "lag": lag,
            "noise": {name: asdict(n) for name, n in self.noise.items()},
            "patch_noise": None if self.patch_noise is None else asdict(self.patch_noise),
            "frozen_clouds": self.frozen,
            "frames": {name: _frames(f) for name, f in self.frames.items()},
            "depth": {name: asdict(d) for name, d in self.depth.items()},
            "convention": CONVENTION,
            "notes": self.notes,
        }
        return _to_json_values(content)


def inspect(recording: Recording) -> Inspection:
    """Inspect an episode.

    Args:
        recording: read by `recordings.read`.

    Raises:
        RecordingError: an image cannot be decoded.
    """
    notes: list[str] = []
    try:
        holding = holding_paths(recording)  # an arm that does not hold the cloth says nothing of the lag
    except TorchclothError as error:  # e.g. joints of an unknown arm; the rest can still be inspected
        holding = {}
        notes.append(f"no gripper paths, so no lag: {error}")
    paths, path_notes = _all_paths(recording, holding)
    notes += path_notes
    checks: dict[str, FrameChecks] = {}
    if recording.markers is not None:
        checks["markers"] = frame_checks.check_marker_frames(recording.markers, recording.cloth)
    if recording.points is not None:
        positions = gripper_positions(holding, recording.points.t + recording.clock_offset)
        checks["points"], cloud_notes = frame_checks.check_cloud_frames(recording.points, recording.cloth, positions)
        notes += cloud_notes
    lag = estimate_lag(recording, holding, {name: ~check.rejected for name, check in checks.items()})
    shift = -recording.clock_offset if lag is None else lag.effective
    depth = {}
    for name, camera in recording.cameras.items():
        try:
            if (summary := depth_images.summarise_depth(camera)) is not None:
                depth[name] = summary
        except MissingDependency as error:
            notes.append(f"{name}: {error}")
    notes += describe_unmodelled_arms(recording)
    is_frozen = np.zeros(0, bool) if recording.points is None else find_frozen_clouds(recording.points)
    estimates, patch_noise = _estimate_noise(recording, holding, checks, shift, is_frozen)
    stated = describe_stated_noise(recording.observation_noise_std, estimates.get("points"), patch_noise)
    notes += [] if stated is None else [stated]
    return Inspection(
        recording,
        {name: timing.summarise_timing(kind, t) for name, (kind, t) in timing.stream_times(recording).items()},
        paths,
        lag,
        estimates,
        patch_noise,
        np.flatnonzero(is_frozen).tolist(),
        checks,
        depth,
        notes + _advice(recording, holding, lag),
    )


def _all_paths(recording: Recording, holding: dict[str, GripperPath]) -> tuple[dict[str, GripperPath], list[str]]:
    """Return the paths of holding and idle grippers, and notes on idle ones without a path."""
    paths, notes = dict(holding), []
    for name in sorted({*recording.grippers, *recording.joints} - holding.keys()) if holding else []:
        try:
            paths |= gripper_paths(recording, [name])
        except TorchclothError as error:
            notes.append(f"{name!r} does not hold the cloth and has no path: {error}")
    return paths, notes


def _estimate_noise(
    recording: Recording,
    holding: dict[str, GripperPath],
    checks: dict[str, FrameChecks],
    shift: float,
    is_frozen: np.ndarray,
) -> tuple[dict[str, NoiseEstimate], PatchNoise | None]:
    estimates, patch_noise = {}, None
    if (markers := recording.markers) is not None:
        estimates["markers"] = noise.estimate_marker_noise(
            markers, standing_frames(holding, markers.t - shift), ~checks["markers"].rejected
        )
    if (points := recording.points) is not None:
        still, positions = standing_frames(holding, points.t - shift), gripper_positions(holding, points.t - shift)
        estimates["points"] = noise.estimate_cloud_noise(points, still if holding else None)
        patch_noise = estimate_patch_noise(points, still & ~is_frozen, positions)
    return {name: value for name, value in estimates.items() if value is not None}, patch_noise


def _advice(recording: Recording, holding: dict[str, GripperPath], lag: LagEstimate | None) -> list[str]:
    """Return notes on what a user should do."""
    remarks = []
    if lag is None and holding:
        remarks.append("no lag: too few observed frames")
    if lag is not None and not lag.is_determined:
        remarks.append(f"the recording does not determine a lag: {LAG_CAVEAT}")
    elif lag is not None and lag.differs_from_recorded:
        remarks.append(
            f"the clocks differ: observations come {lag.value:.3f} s late, the recording says {lag.recorded:.3f} s; "
            f"set clock_offset to {-lag.value:.3f} if the stamps are wrong"
        )
    if (size_notes := size_checks.detect_wrong_size(recording)) is not None:
        remarks.append("; ".join(size_notes))
    if recording.points is None and recording.markers is None:
        remarks.append("no points and no markers: nothing to compare a simulation with")
    return remarks


def _frames(checks: FrameChecks) -> dict[str, Any]:
    return {
        "rejected": np.flatnonzero(checks.rejected),
        "rejected_fraction": checks.rejected.mean(),
        "criterion": checks.criterion,
        "coverage": checks.coverage,
        "removed": checks.removed,
        "crop_planes": checks.crop_planes,
    }


def _to_json_values(value: Any) -> Any:
    """Convert arrays and numpy numbers to lists and numbers; NaN becomes None."""
    if isinstance(value, dict):
        return {str(key): _to_json_values(item) for key, item in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [_to_json_values(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not np.isfinite(value) else value
