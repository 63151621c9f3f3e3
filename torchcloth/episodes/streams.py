"""Bring points, markers and forces onto one list of frame times."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from ..errors import InvalidInput
from ..losses import ClosestPoints, find_closest_points
from ..meshes import Mesh
from ..recordings import GripperMotion, JointMotion, Recording

SAME_TIME_S = 1e-6  # times nearer than this are one
MAX_FORCE_RATE_HZ = 30.0  # of frames where there are only forces: each is a mean, so no reading is lost
MAX_DISTANCE_FROM_PATTERN_M = 5e-3  # of a marker from the cloth's pattern


def merge_times(times: Sequence[np.ndarray]) -> np.ndarray:
    """Return all times [T] s in order, equal ones once."""
    merged = np.sort(np.concatenate(times))
    return merged[np.concatenate([[True], np.diff(merged) > SAME_TIME_S])]


def find_force_times(recording: Recording, names: Sequence[str]) -> np.ndarray:
    """Return times [T] s of the grippers' readings, thinned to 30 Hz; empty where nothing was measured."""
    knots = [motion.t for motion in _measuring_motions(recording, names).values()]
    if not knots:
        return np.empty(0)
    merged = merge_times(knots)
    bins = np.floor((merged - merged[0]) * MAX_FORCE_RATE_HZ + SAME_TIME_S)
    return merged[np.concatenate([[True], np.diff(bins) > 0])]


def match_frames(times: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """Return the frame index [N] of each time, -1 where there is none; frame times are in order."""
    after = np.searchsorted(frames, times).clip(max=len(frames) - 1)
    before = (after - 1).clip(min=0)
    nearest = np.where(np.abs(frames[before] - times) <= np.abs(frames[after] - times), before, after)
    return np.where(np.abs(frames[nearest] - times) <= SAME_TIME_S, nearest, -1)


def drop_duplicate_markers(recording: Recording) -> Recording:
    """Remove markers that are no material points if there is a cloud, in which they would count twice."""
    markers = recording.markers
    is_duplicate = recording.points is not None and markers is not None and markers.uv is None
    return replace(recording, markers=None) if is_duplicate else recording


def gather_clouds(recording: Recording, frames: np.ndarray, dtype: torch.dtype) -> list[Tensor]:
    """Return one cloud [N, 3] m per frame, empty without points; markers without ``uv`` are points like others."""
    parts: list[list[np.ndarray]] = [[] for _ in frames]
    points, markers = recording.points, recording.markers
    if points is not None:
        for i, frame in enumerate(match_frames(points.t + recording.clock_offset, frames)):
            if frame >= 0:
                parts[frame].append(np.asarray(points.frame(i)))
    if markers is not None and markers.uv is None:
        for i, frame in enumerate(match_frames(markers.t + recording.clock_offset, frames)):
            if frame >= 0:
                parts[frame].append(markers.xyz[i][np.isfinite(markers.xyz[i]).all(-1)])
    return [torch.as_tensor(np.concatenate(part) if part else np.empty((0, 3)), dtype=dtype) for part in parts]


def gather_markers(recording: Recording, frames: np.ndarray, dtype: torch.dtype) -> Tensor | None:
    """Return marker positions [T, M, 3] m, NaN where hidden; None without markers that are material points."""
    markers = recording.markers
    if markers is None or markers.uv is None:
        return None
    out = torch.full((len(frames), *markers.xyz.shape[1:]), torch.nan, dtype=dtype)
    frame = match_frames(markers.t + recording.clock_offset, frames)
    out[frame[frame >= 0]] = torch.as_tensor(markers.xyz[frame >= 0], dtype=dtype)
    return out


def locate_on_pattern(mesh: Mesh, uv: np.ndarray, name: str = "markers.uv") -> ClosestPoints:
    """Find where pattern points lie on a mesh.

    Args:
        mesh: with pattern coordinates.
        uv: [M, 2] m.
        name: of the points, in messages.

    Raises:
        InvalidInput: a point that is not on the pattern, or a mesh without pattern coordinates.
    """
    if mesh.pattern is None:
        raise InvalidInput(name, got="a mesh without pattern coordinates", expected="cloth.obj with vt")
    corners = torch.as_tensor(mesh.pattern, dtype=torch.float64).reshape(-1, 2)
    flat = torch.nn.functional.pad(corners, (0, 1))
    points = torch.nn.functional.pad(torch.as_tensor(uv, dtype=torch.float64), (0, 1))
    hits = find_closest_points(points, flat, torch.arange(len(flat)).reshape(-1, 3))
    distance = (points - hits.interpolate(flat)).norm(dim=-1)
    if float(distance.max()) > MAX_DISTANCE_FROM_PATTERN_M:
        place = f"{name}[{int(distance.argmax())}]"
        raise InvalidInput(place, got=f"{float(distance.max()):.3f} m off the cloth", expected="on its pattern")
    return hits._replace(corners=torch.as_tensor(mesh.faces).reshape(-1)[hits.corners])


def average_wrenches(
    recording: Recording, names: Sequence[str], frames: np.ndarray, dtype: torch.dtype
) -> Mapping[str, Tensor]:
    """Return the wrench that the cloth exerts on each gripper, name -> [T, 6] N and N m, NaN where not measured.

    As in a rollout, it is the mean over the interval that ends at the frame. Readings are linear between knots.
    """
    out = {}
    for name, motion in _measuring_motions(recording, names).items():
        missing = np.full((len(motion.t), 3), np.nan)
        parts = [missing if part is None else np.asarray(part) for part in (motion.force, motion.torque)]
        means = _interval_means(np.asarray(motion.t), np.concatenate(parts, axis=1), frames)
        out[name] = torch.as_tensor(means, dtype=dtype)
    return out


def _measuring_motions(recording: Recording, names: Sequence[str]) -> dict[str, GripperMotion | JointMotion]:
    """Motions that hold force or torque readings, by name."""
    motions = {name: recording.grippers.get(name) or recording.joints.get(name) for name in names}
    return {name: m for name, m in motions.items() if m is not None and not (m.force is None and m.torque is None)}


def _interval_means(t: np.ndarray, value: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """Means [T, C] of a piecewise linear signal [K, C] between frames; the first frame ends no interval.

    They are NaN over intervals that contain a NaN.
    """
    nan_count = np.concatenate([np.zeros_like(value[:1]), np.cumsum(np.isnan(value), axis=0)])
    value = np.where(np.isnan(value), 0.0, value)
    area = 0.5 * np.diff(t)[:, None] * (value[1:] + value[:-1])
    total = np.concatenate([np.zeros_like(value[:1]), np.cumsum(area, axis=0)])
    at = np.clip(frames, t[0], t[-1])
    before = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 2)  # last knot at or before each frame
    after = np.searchsorted(t, at).clip(max=len(t) - 1)  # first knot at or after each frame
    here = np.stack([np.interp(at, t, column) for column in value.T], axis=1)
    integral = total[before] + 0.5 * (at - t[before])[:, None] * (value[before] + here)
    out = np.full((len(frames), value.shape[1]), np.nan)
    out[1:] = np.diff(integral, axis=0) / np.diff(frames)[:, None]
    out[1:][nan_count[after[1:] + 1] > nan_count[before[:-1]]] = np.nan
    return out
