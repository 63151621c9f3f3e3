"""What was seen and felt, brought onto one list of frame times."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from ..errors import InvalidInput
from ..losses import Hits, closest
from ..meshes import Mesh
from ..recordings import GripperMotion, JointMotion, Recording

SAME = 1e-6  # s, times nearer than this are one
FELT_RATE = 30.0  # 1/s, of frames where there is nothing but forces: each is a mean, so no reading is lost
OFF_PATTERN = 5e-3  # m, of a marker from the cloth's pattern


def joined(times: Sequence[np.ndarray]) -> np.ndarray:
    """All times [T] s in order, equal ones once."""
    every = np.sort(np.concatenate(times))
    return every[np.concatenate([[True], np.diff(every) > SAME])]


def felt(recording: Recording, names: Sequence[str]) -> np.ndarray:
    """Times [T] s of the grippers' readings, thinned to ``FELT_RATE``; empty where nothing was measured."""
    knots = [motion.t for motion in _measuring(recording, names).values()]
    if not knots:
        return np.empty(0)
    every = joined(knots)
    bins = np.floor((every - every[0]) * FELT_RATE + SAME)
    return every[np.concatenate([[True], np.diff(bins) > 0])]


def places(times: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """[N] the frame of each time; -1 where there is none. Frames are in order."""
    after = np.searchsorted(frames, times).clip(max=len(frames) - 1)
    before = (after - 1).clip(min=0)
    near = np.where(np.abs(frames[before] - times) <= np.abs(frames[after] - times), before, after)
    return np.where(np.abs(frames[near] - times) <= SAME, near, -1)


def without_doubles(recording: Recording) -> Recording:
    """Without markers that are no material points, where there are points: they would be a cloud seen twice."""
    doubled = recording.points is not None and recording.markers is not None and recording.markers.uv is None
    return replace(recording, markers=None) if doubled else recording


def clouds(recording: Recording, frames: np.ndarray, dtype: torch.dtype) -> list[Tensor]:
    """One cloud [N, 3] m a frame, empty where none was seen. Markers without ``uv`` are points like others."""
    found: list[list[np.ndarray]] = [[] for _ in frames]
    points, markers = recording.points, recording.markers
    if points is not None:
        for i, place in enumerate(places(points.t + recording.clock_offset, frames)):
            if place >= 0:
                found[place].append(np.asarray(points.frame(i)))
    if markers is not None and markers.uv is None:
        for i, place in enumerate(places(markers.t + recording.clock_offset, frames)):
            if place >= 0:
                found[place].append(markers.xyz[i][np.isfinite(markers.xyz[i]).all(-1)])
    return [torch.as_tensor(np.concatenate(part) if part else np.empty((0, 3)), dtype=dtype) for part in found]


def markers(recording: Recording, frames: np.ndarray, dtype: torch.dtype) -> Tensor | None:
    """[T, M, 3] m, NaN where unseen; None without markers that are material points."""
    given = recording.markers
    if given is None or given.uv is None:
        return None
    out = torch.full((len(frames), *given.xyz.shape[1:]), torch.nan, dtype=dtype)
    place = places(given.t + recording.clock_offset, frames)
    out[place[place >= 0]] = torch.as_tensor(given.xyz[place >= 0], dtype=dtype)
    return out


def on_pattern(mesh: Mesh, uv: np.ndarray, name: str = "markers.uv") -> Hits:
    """Where pattern points [M, 2] m lie on a mesh; ``name`` is what messages call them.

    Raises:
        InvalidInput: a point that is not on the pattern, or a mesh without pattern coordinates.
    """
    if mesh.pattern is None:
        raise InvalidInput(name, got="a mesh without pattern coordinates", expected="cloth.obj with vt")
    corners = torch.as_tensor(mesh.pattern, dtype=torch.float64).reshape(-1, 2)
    flat = torch.nn.functional.pad(corners, (0, 1))
    points = torch.nn.functional.pad(torch.as_tensor(uv, dtype=torch.float64), (0, 1))
    hits = closest(points, flat, torch.arange(len(flat)).reshape(-1, 3))
    off = (points - hits.on(flat)).norm(dim=-1)
    if float(off.max()) > OFF_PATTERN:
        raise InvalidInput(
            f"{name}[{int(off.argmax())}]", got=f"{float(off.max()):.3f} m off the cloth", expected="on its pattern"
        )
    return hits._replace(corners=torch.as_tensor(mesh.faces).reshape(-1)[hits.corners])


def wrenches(
    recording: Recording, names: Sequence[str], frames: np.ndarray, dtype: torch.dtype
) -> Mapping[str, Tensor]:
    """What the cloth exerts on each gripper, name -> [T, 6] N and N m, NaN where not measured.

    As in a rollout: the mean over the interval that ends at the frame. Readings are taken as linear between knots.
    """
    out = {}
    for name, motion in _measuring(recording, names).items():
        nothing = np.full((len(motion.t), 3), np.nan)
        parts = [nothing if part is None else np.asarray(part) for part in (motion.force, motion.torque)]
        out[name] = torch.as_tensor(_means(np.asarray(motion.t), np.concatenate(parts, axis=1), frames), dtype=dtype)
    return out


def _measuring(recording: Recording, names: Sequence[str]) -> dict[str, GripperMotion | JointMotion]:
    """The motions that hold readings, by name."""
    motions = {name: recording.grippers.get(name) or recording.joints.get(name) for name in names}
    return {name: m for name, m in motions.items() if m is not None and not (m.force is None and m.torque is None)}


def _means(t: np.ndarray, value: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """Means [T, C] of a piecewise linear signal [K, C] between frames; the first frame ends no interval.

    NaN over intervals that a NaN reaches into.
    """
    lost = np.concatenate([np.zeros_like(value[:1]), np.cumsum(np.isnan(value), axis=0)])
    value = np.where(np.isnan(value), 0.0, value)
    area = 0.5 * np.diff(t)[:, None] * (value[1:] + value[:-1])
    total = np.concatenate([np.zeros_like(value[:1]), np.cumsum(area, axis=0)])
    at = np.clip(frames, t[0], t[-1])
    k = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 2)
    here = np.stack([np.interp(at, t, column) for column in value.T], axis=1)
    integral = total[k] + 0.5 * (at - t[k])[:, None] * (value[k] + here)
    out = np.full((len(frames), value.shape[1]), np.nan)
    out[1:] = np.diff(integral, axis=0) / np.diff(frames)[:, None]
    last = np.searchsorted(t, at).clip(max=len(t) - 1)  # knot at or after each frame; k is the one at or before
    out[1:][lost[last[1:] + 1] > lost[k[:-1]]] = np.nan
    return out
