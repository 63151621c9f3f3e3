"""Film of a recording."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import torch

from ..boundaries.motion import interpolate_poses
from ..errors import InvalidInput, RecordingError, TorchclothError
from ..observe import DepthCamera, build_solid_mesh, decode_depth, to_points
from ..recordings import Collider, Recording
from ..robots import arm_from_recording, replay  # pyright: ignore[reportMissingImports] - mapped from robots/ at installation
from ..robots.replay import unwrap_joints  # pyright: ignore[reportMissingImports]
from ..types import Trajectory
from .film import (
    MARKER_COLOUR,
    TRUTH_COLOUR,
    CameraView,
    ClothSurface,
    Cloud,
    Curve,
    Film,
    GripperPath,
    GroundPlane,
    RigidBody,
)
from .geometry import Array, nearest_indices

FILM_RATE_HZ = 25.0  # of episodes without observations
PLANE_MARGIN_M = 0.3  # a collider's plane is drawn this far beyond what lies over it
MAX_DEPTH_POINTS = 4000  # shown of one depth image
MAX_TIME_OFFSET_FRAMES = 0.5  # frame periods of the slower stream; observations farther away are not shown


def film_from_recording(recording: Recording, *, truth: bool = False, times: Array | None = None) -> Film:
    """Make a film of an episode: points, markers, arms, gripper paths, colliders, cameras and forces.

    Streams that were not recorded are not shown. Without points and markers, depth images are shown as points, within
    their masks if there are any.

    Args:
        recording: an episode.
        truth: also show the true cloth of a synthetic episode (read it with ``with_truth=True``).
        times: [T] s on the motion clock; None: those of the points, else of markers, images or truth, else 25 per
            second.

    Raises:
        RecordingError: the truth is requested and missing, or nothing in the episode has a time.
        MissingDependency: the episode has joints, and the packages of the kinematics are not installed.
    """
    if truth:
        recording.require("truth", by="--truth")
    times = _times(recording, truth) if times is None else np.asarray(times, dtype=float)
    arms, paths, notes = _arms(recording, times)
    if recording.grippers:
        paths = {**replay(replace(recording, joints={})), **paths}
    clouds, views = _clouds(recording, times), _views(recording, times)
    if not clouds:
        clouds, depth_notes = _depth_clouds(recording, views, times)
        notes += depth_notes
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
    planes = {f"colliders/{name}": _plane(c, film.bounds) for name, c in recording.colliders.items()}
    return replace(film, planes=planes)


def _times(recording: Recording, truth: bool) -> Array:
    """Return the times [T] s of the observations on the motion clock, or others if there are none."""
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
    return (
        np.linspace(start, end, max(2, round((end - start) * FILM_RATE_HZ) + 1)) if end > start else np.array([start])
    )


def _nearest_entries(stream_times: Array, times: Array) -> Array:
    """Return [T] the entry of an observed stream that belongs to each frame; -1 if none is near."""
    index = nearest_indices(stream_times, times)
    gap = MAX_TIME_OFFSET_FRAMES * max(
        (float(np.median(np.diff(t))) for t in (stream_times, times) if len(t) > 1), default=0.0
    )
    return np.where(np.abs(stream_times[index] - times) <= gap * (1 + 1e-6) + 1e-9, index, -1)


def _clouds(recording: Recording, times: Array) -> dict[str, Cloud]:
    out, no_points = {}, np.zeros((0, 3), np.float32)
    if (points := recording.points) is not None:
        index = _nearest_entries(points.t + recording.clock_offset, times)
        cuts = np.split(points.xyz.astype(np.float32), np.cumsum(points.counts)[:-1])
        out["points"] = Cloud(tuple(no_points if i < 0 else cuts[i] for i in index))
    if (markers := recording.markers) is not None:
        index = _nearest_entries(markers.t + recording.clock_offset, times)
        rows = [no_points if i < 0 else markers.xyz[i].astype(np.float32) for i in index]
        out["markers"] = Cloud(tuple(row[np.isfinite(row).all(axis=-1)] for row in rows), MARKER_COLOUR)
    return out


def _depth_clouds(
    recording: Recording, views: dict[str, CameraView], times: Array
) -> tuple[dict[str, Cloud], list[str]]:
    """Return the points of each camera's depth images, and notes on images that are not drawn."""
    clouds, notes = {}, []
    for name, view in views.items():
        try:
            camera = DepthCamera.from_recording(view.camera)
        except InvalidInput as error:
            notes.append(f"depth of {name!r} is not drawn: {error}")
            continue
        if view.camera.depth is not None and (scale := view.camera.depth_scale) is not None:
            clouds[f"depth/{name}"] = _depth_cloud(view, camera, scale, times)
    if not clouds:
        images = any(v.camera.depth or v.camera.color or v.camera.mask for v in views.values())
        images_note = "images are not drawn" if images else "no images"
        notes.append(f"no observation of the cloth is drawn: no points, no markers, {images_note}")
    return clouds, notes


def _depth_cloud(view: CameraView, camera: DepthCamera, scale: float, times: Array) -> Cloud:
    """Return a camera's depth images as thinned point clouds."""
    depth, mask, frames = view.camera.depth, view.camera.mask, []
    mask_rows = {} if mask is None else {number: k for k, number in enumerate(mask.frames.tolist())}
    for frame in range(len(times)):
        depth_image = view.depth_image(frame)
        if depth_image is None or depth is None:
            frames.append(np.zeros((0, 3), np.float32))
            continue
        row = mask_rows.get(int(depth.frames[view.index[frame]]))  # the cloth has moved since any other mask
        inside = None if row is None or mask is None else mask.load(row) > 0
        points = to_points(camera, decode_depth(depth_image, scale), inside)
        frames.append(points[:: max(1, -(-len(points) // MAX_DEPTH_POINTS))].astype(np.float32))
    return Cloud(tuple(frames))


def _truth(recording: Recording, times: Array) -> ClothSurface:
    """Return the true vertices, interpolated linearly between their times."""
    truth = recording.require("truth", by="--truth")
    right = np.clip(np.searchsorted(truth.t, times), 1, max(1, len(truth.t) - 1))
    left, right = right - 1, np.minimum(right, len(truth.t) - 1)
    share = np.clip((times - truth.t[left]) / np.maximum(truth.t[right] - truth.t[left], 1e-12), 0, 1)[:, None, None]
    x = (1 - share) * truth.vertices[left] + share * truth.vertices[right]
    return ClothSurface(x.astype(np.float32), truth.faces, colour=TRUTH_COLOUR)


def _arms(recording: Recording, times: Array) -> tuple[dict[str, RigidBody], dict[str, Trajectory], list[str]]:
    """Return the bodies and the gripper path of each arm with recorded joints, and notes on arms not drawn."""
    solids, paths, notes = {}, {}, []
    for name, motion in recording.joints.items():
        try:
            arm = arm_from_recording(recording, name)
            q = np.stack([np.interp(times, motion.t, column) for column in unwrap_joints(arm, motion.q).T], axis=-1)
            with warnings.catch_warnings(action="ignore"):  # of meshes that cannot be read: notes name them
                shapes = arm.geometry(torch.as_tensor(q, dtype=arm.base.dtype))
            paths |= replay(replace(recording, grippers={}, joints={name: motion}))
            notes += [f"arm {name!r}: {link} is not drawn: {why}" for link, why in arm.unread_meshes.items()]
        except ImportError:
            raise
        except TorchclothError as error:
            notes.append(f"arm {name!r} is not drawn: {error}")
            continue
        for number, shape in enumerate(shapes):
            vertices, faces = shape.mesh or build_solid_mesh(shape.kind, shape.size, np.eye(4), segments=16)
            solids[f"arms/{name}/{number}-{shape.link}"] = RigidBody(vertices, faces, _poses(shape.pose, len(times)))
    return solids, paths, notes


def _poses(pose: torch.Tensor, count: int) -> Array:
    """Return poses [T, 4, 4], or [1, 4, 4] of a body that never moves."""
    poses = np.broadcast_to(pose.detach().numpy(), (count, 4, 4))
    return poses[:1] if np.allclose(poses, poses[0], rtol=0, atol=1e-9) else poses


def _trace(path: Trajectory, times: Array) -> GripperPath:
    inside = np.clip(times, float(path.t[0]), float(path.t[-1]))
    poses = interpolate_poses(path, torch.as_tensor(inside))
    return GripperPath(path.pose[:, :3, 3].numpy(), poses.numpy())


def _plane(collider: Collider, bounds: tuple[Array, Array]) -> GroundPlane:
    """Return a square of a collider's surface that extends under the whole scene."""
    low, high = bounds
    normal = collider.normal / np.linalg.norm(collider.normal)
    middle = (low + high) / 2
    centre = middle - ((middle - collider.point) @ normal) * normal
    first = np.cross(np.eye(3)[np.argmin(np.abs(normal))], normal)
    first /= np.linalg.norm(first)
    axes = (float(np.linalg.norm(high - low)) / 2 + PLANE_MARGIN_M) * np.stack([first, np.cross(normal, first)])
    return GroundPlane(centre + np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]]) @ axes)


def _views(recording: Recording, times: Array) -> dict[str, CameraView]:
    out = {}
    for name, camera in recording.cameras.items():
        index = np.full(len(times), -1)
        if camera.depth is not None and camera.depth_scale is not None:
            index = _nearest_entries(camera.depth.t + recording.clock_offset, times)
        out[name] = CameraView(camera, index)
    return out


def _curves(recording: Recording) -> dict[str, Curve]:
    """Return the magnitude of each measured gripper force over time."""
    out = {}
    for name, motion in {**recording.joints, **recording.grippers}.items():
        if motion.force is not None:
            out[f"force/{name}"] = Curve(motion.t, np.linalg.norm(motion.force, axis=-1), "N")
    return out
