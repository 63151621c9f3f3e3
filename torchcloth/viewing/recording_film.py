"""A recording as a film."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from ..boundaries.motion import interpolate_poses
from ..errors import InvalidInput, RecordingError, TorchclothError
from ..observe import DepthCamera, decode, solid_mesh, to_points
from ..recordings import Collider, Recording
from ..robots import arm_from_recording, replay  # pyright: ignore[reportMissingImports] - mapped from robots/ at installation
from ..robots.replay import unwrap_joints  # pyright: ignore[reportMissingImports]
from ..types import Trajectory
from .film import (
    MARKERS,
    TRUTH,
    Cloud,
    Curve,
    Film,
    Plane,
    Sheet,
    Solid,
    Trace,
    View,
)
from .geometry import Array, nearest

RATE = 25.0  # 1/s, frames of an episode that was not observed
MARGIN = 0.3  # m, by which a collider's plane is drawn beyond what lies over it
FROM_DEPTH = 4000  # points of a depth image that are shown at most
SLACK = 0.5  # of the time between two frames of the slower stream: what was seen farther away is not shown


def film_of(recording: Recording, *, truth: bool = False, times: Array | None = None) -> Film:
    """What an episode holds: points, markers, arms, grippers' paths, colliders, cameras, forces.

    A stream that was not recorded is not shown. Depth images are shown as points where there are no other points, and
    no markers: within their masks where there are some.

    Args:
        recording: an episode.
        truth: show the true cloth of a synthetic episode too (read it with ``with_truth=True``).
        times: [T] s on the motion clock; None: those of the points, else of markers, images or truth, else 25 a second.

    Raises:
        RecordingError: truth was asked for and is not there, or nothing in the episode has a time.
        MissingDependency: the kinematics' packages are not installed and the episode has joints.
    """
    if truth:
        recording.require("truth", by="--truth")
    times = _times(recording, truth) if times is None else np.asarray(times, dtype=float)
    arms, paths, notes = _arms(recording, times)
    if recording.grippers:
        paths = {**replay(replace(recording, joints={})), **paths}
    clouds, views = _clouds(recording, times), _views(recording, times)
    if not clouds:
        clouds, more = _depths(recording, views, times)
        notes += more
    film = Film(
        title=recording.path.name if recording.path else "recording",
        times=times,
        sheets={"truth": _truth(recording, times)} if truth else {},
        clouds=clouds,
        solids=arms,
        traces={f"grippers/{name}": _trace(path, times) for name, path in paths.items()},
        views={f"cameras/{name}": view for name, view in views.items()},
        curves=_curves(recording),
        notes=tuple(notes),
    )
    planes = {f"colliders/{name}": _plane(c, film.box) for name, c in recording.colliders.items()}
    return replace(film, planes=planes)


def _times(recording: Recording, truth: bool) -> Array:
    """On the motion clock; observations are brought to it."""
    offset = recording.clock_offset
    for stream in (recording.points, recording.markers):
        if stream is not None:
            return stream.t + offset
    for camera in recording.cameras.values():
        for images in (camera.depth, camera.color):
            if images is not None:
                return images.t + offset
    if truth and recording.truth is not None:
        return recording.truth.t
    motions = [*recording.grippers.values(), *recording.joints.values()]
    if not motions:
        raise RecordingError(f"{recording.path}: nothing to view", expected="points, markers, images or motion")
    start, end = min(m.t[0] for m in motions), max(m.t[-1] for m in motions)
    return np.linspace(start, end, max(2, round((end - start) * RATE) + 1)) if end > start else np.array([start])


def _seen(stream_times: Array, times: Array) -> Array:
    """[T] which entry of an observed stream belongs to each frame; -1 where none is near."""
    index = nearest(stream_times, times)
    gap = SLACK * max((float(np.median(np.diff(t))) for t in (stream_times, times) if len(t) > 1), default=0.0)
    return np.where(np.abs(stream_times[index] - times) <= gap * (1 + 1e-6) + 1e-9, index, -1)


def _clouds(recording: Recording, times: Array) -> dict[str, Cloud]:
    out, nothing = {}, np.zeros((0, 3), np.float32)
    if (points := recording.points) is not None:
        index = _seen(points.t + recording.clock_offset, times)
        cuts = np.split(points.xyz.astype(np.float32), np.cumsum(points.counts)[:-1])
        out["points"] = Cloud(tuple(nothing if i < 0 else cuts[i] for i in index))
    if (markers := recording.markers) is not None:
        index = _seen(markers.t + recording.clock_offset, times)
        rows = [nothing if i < 0 else markers.xyz[i].astype(np.float32) for i in index]
        out["markers"] = Cloud(tuple(row[np.isfinite(row).all(axis=-1)] for row in rows), MARKERS)
    return out


def _depths(recording: Recording, views: dict[str, View], times: Array) -> tuple[dict[str, Cloud], list[str]]:
    """What the depth images of each camera show; what is not drawn, and why."""
    clouds, notes = {}, []
    for name, view in views.items():
        try:
            camera = DepthCamera.of(view.camera)
        except InvalidInput as error:
            notes.append(f"depth of {name!r} is not drawn: {error}")
            continue
        if view.camera.depth is not None and (scale := view.camera.depth_scale) is not None:
            clouds[f"depth/{name}"] = _from_depth(view, camera, scale, times)
    if not clouds:
        images = any(v.camera.depth or v.camera.color or v.camera.mask for v in views.values())
        found = "images are not drawn" if images else "no images"
        notes.append(f"nothing that was seen of the cloth is drawn: no points, no markers, {found}")
    return clouds, notes


def _from_depth(view: View, camera: DepthCamera, scale: float, times: Array) -> Cloud:
    """A camera's depth images as points, thinned."""
    depth, mask, frames = view.camera.depth, view.camera.mask, []
    place = {} if mask is None else {number: k for k, number in enumerate(mask.frames.tolist())}
    for frame in range(len(times)):
        raw = view.raw(frame)
        if raw is None or depth is None:
            frames.append(np.zeros((0, 3), np.float32))
            continue
        own = place.get(int(depth.frames[view.index[frame]]))  # another image's would cut off what has moved
        inside = None if own is None or mask is None else mask.load(own) > 0
        points = to_points(camera, decode(raw, scale), inside)
        frames.append(points[:: max(1, -(-len(points) // FROM_DEPTH))].astype(np.float32))
    return Cloud(tuple(frames))


def _truth(recording: Recording, times: Array) -> Sheet:
    """The true vertices, linear between their times."""
    found = recording.require("truth", by="--truth")
    right = np.clip(np.searchsorted(found.t, times), 1, max(1, len(found.t) - 1))
    left, right = right - 1, np.minimum(right, len(found.t) - 1)
    share = np.clip((times - found.t[left]) / np.maximum(found.t[right] - found.t[left], 1e-12), 0, 1)[:, None, None]
    x = (1 - share) * found.vertices[left] + share * found.vertices[right]
    return Sheet(x.astype(np.float32), found.faces, colour=TRUTH)


def _arms(recording: Recording, times: Array) -> tuple[dict[str, Solid], dict[str, Trajectory], list[str]]:
    """The solids and the gripper's path of every arm whose joints were recorded; why others are not drawn."""
    solids, paths, notes = {}, {}, []
    for name, motion in recording.joints.items():
        try:
            arm = arm_from_recording(recording, name)
            q = np.stack([np.interp(times, motion.t, own) for own in unwrap_joints(arm, motion.q).T], axis=-1)
            shapes = arm.geometry(torch.as_tensor(q, dtype=arm.base.dtype))
            paths |= replay(replace(recording, grippers={}, joints={name: motion}))
            if arm.links_without_primitives:
                notes.append(f"of arm {name!r} links that are meshes alone are not drawn: {', '.join(arm.links_without_primitives)}")
        except ImportError:
            raise
        except TorchclothError as error:
            notes.append(f"arm {name!r} is not drawn: {error}")
            continue
        for number, shape in enumerate(shapes):
            vertices, faces = solid_mesh(shape.kind, shape.size, np.eye(4), segments=16)
            solids[f"arms/{name}/{number}-{shape.link}"] = Solid(vertices, faces, _poses(shape.pose, len(times)))
    return solids, paths, notes


def _poses(pose: torch.Tensor, count: int) -> Array:
    """[T, 4, 4], or [1, 4, 4] of what never moves."""
    poses = np.broadcast_to(pose.detach().numpy(), (count, 4, 4))
    return poses[:1] if np.allclose(poses, poses[0], rtol=0, atol=1e-9) else poses


def _trace(path: Trajectory, times: Array) -> Trace:
    inside = np.clip(times, float(path.t[0]), float(path.t[-1]))
    poses = interpolate_poses(path, torch.as_tensor(inside))
    return Trace(path.pose[:, :3, 3].numpy(), poses.numpy())


def _plane(collider: Collider, box: tuple[Array, Array]) -> Plane:
    """A square of a collider's surface under everything."""
    low, high = box
    normal = collider.normal / np.linalg.norm(collider.normal)
    middle = (low + high) / 2
    centre = middle - ((middle - collider.point) @ normal) * normal
    first = np.cross(np.eye(3)[np.argmin(np.abs(normal))], normal)
    first /= np.linalg.norm(first)
    axes = (float(np.linalg.norm(high - low)) / 2 + MARGIN) * np.stack([first, np.cross(normal, first)])
    return Plane(centre + np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]]) @ axes)


def _views(recording: Recording, times: Array) -> dict[str, View]:
    out = {}
    for name, camera in recording.cameras.items():
        index = np.full(len(times), -1)
        if camera.depth is not None and camera.depth_scale is not None:
            index = _seen(camera.depth.t + recording.clock_offset, times)
        out[name] = View(camera, index)
    return out


def _curves(recording: Recording) -> dict[str, Curve]:
    """Size of each measured gripper force."""
    out = {}
    for name, motion in {**recording.joints, **recording.grippers}.items():
        if motion.force is not None:
            out[f"force/{name}"] = Curve(motion.t, np.linalg.norm(motion.force, axis=-1), "N")
    return out
