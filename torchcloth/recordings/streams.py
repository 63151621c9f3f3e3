"""Turns the arrays of motion.npz, points.npz, markers.npz and truth.npz into the bags of `types`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..errors import RecordingError
from . import checks
from .checks import Fields
from .files import Folder
from .types import GripperMotion, JointMotion, Markers, PointClouds, Truth

WIDEST_GRIPPER = 1.0  # m
LARGEST_ANGLE = 4 * np.pi  # rad; no arm joint turns further, and a few degrees already exceed it
MOTION, POINTS, MARKERS, TRUTH = "motion.npz", "points.npz", "markers.npz", "truth.npz"


def motions(
    groups: Mapping[str, dict[str, np.ndarray]], file: str
) -> tuple[dict[str, GripperMotion], dict[str, JointMotion]]:
    """Turn the arrays of each name into grippers and arms; one name may be both. ``file`` is for messages."""
    grippers: dict[str, GripperMotion] = {}
    joints: dict[str, JointMotion] = {}
    for name, group in groups.items():
        place = f"{file}: {name}"
        if not {"position", "quat_wxyz", "q"} & group.keys():
            raise RecordingError(f"{place} has no motion", got=sorted(group), expected="position and quat_wxyz, or q")
        fields = Fields(group, place, "/")
        shared = _shared(fields)
        arm = _arm(fields, len(shared["t"])) if "q" in group else {}
        pose = _pose(fields, shared) if {"position", "quat_wxyz"} & group.keys() else {}
        if arm:
            joints[name] = JointMotion(**shared, **arm, extra=fields.left())
        if pose:
            grippers[name] = GripperMotion(**shared, **pose, extra=fields.left())
    return grippers, joints


def points(arrays: dict[str, np.ndarray], file: str) -> PointClouds:
    """Turn the arrays of the point clouds, floats in metres or int16 with a scale, into clouds."""
    fields = Fields(arrays, file, ": ")
    t = _times(fields)
    counts = fields.array("counts", len(t), kind="int")
    stored = fields.take("xyz")
    compact = stored.dtype == np.int16
    if not compact and stored.dtype.kind != "f":
        raise RecordingError(
            f"{fields.at('xyz')} has the wrong dtype", got=stored.dtype, expected="float32 or int16 (+ scale)"
        )
    if compact != fields.has("scale"):
        got = f"{stored.dtype} {'with' if fields.has('scale') else 'without'} scale"
        raise RecordingError(
            f"{fields.at('scale')} does not fit xyz", got=got, expected="int16 with scale, or floats without"
        )
    xyz = checks.array(stored, fields.at("xyz"), ("N", 3))
    if compact:
        scale = float(fields.array("scale"))
        if scale <= 0:
            raise RecordingError(f"{fields.at('scale')} is not positive", got=scale, expected="metres per unit")
        xyz *= scale
    if counts.min() < 1:
        i = int(np.argmin(counts))
        got = f"{counts[i]} points in frame {i}"
        raise RecordingError(
            f"{fields.at('counts')} has an empty cloud", got=got, expected="at least 1", remedy="leave the frame out"
        )
    if counts.max() > len(xyz) or counts.sum() != len(xyz):  # the first test also keeps the sum from overflowing
        got = f"counts for {sum(counts.tolist())} points, {len(xyz)} in xyz"
        raise RecordingError(f"{fields.at('counts')} does not match xyz", got=got, expected="sum(counts) == len(xyz)")
    checks.metres(xyz, fields.at("xyz"))
    return PointClouds(t, xyz, counts, fields.left())


def markers(folder: Folder) -> Markers:
    """Read the markers; a marker is seen whole or not at all."""
    fields = Fields(folder.npz(MARKERS), folder.place(MARKERS), ": ")
    t = _times(fields)
    xyz = fields.array("xyz", len(t), "M", 3, nan=True)
    unseen = np.isnan(xyz)
    if (unseen.any(axis=-1) != unseen.all(axis=-1)).any():
        raise RecordingError(
            f"{fields.at('xyz')} is half seen", got="NaN in one or two coordinates", expected="all three or none"
        )
    if unseen.all():
        raise RecordingError(
            f"{fields.at('xyz')} is empty", got="no marker seen in any frame", remedy="leave the file out"
        )
    checks.metres(xyz, fields.at("xyz"))
    uv = fields.maybe(fields.array, "uv", xyz.shape[1], 2)
    return Markers(t, xyz, uv, fields.left())


def truth(folder: Folder) -> Truth:
    """Read the true motion of a synthetic episode."""
    fields = Fields(folder.npz(TRUTH), folder.place(TRUTH), ": ")
    t = _times(fields)
    vertices = fields.array("vertices", len(t), "V", 3)
    checks.metres(vertices, fields.at("vertices"))
    faces = fields.array("faces", "F", 3, kind="int")
    if faces.size == 0 or faces.min() < 0 or faces.max() >= vertices.shape[1]:
        raise RecordingError(
            f"{fields.at('faces')} does not fit vertices", expected=f"indices below {vertices.shape[1]}"
        )
    return Truth(t, vertices, faces, fields.left())


def groups(folder: Folder) -> dict[str, dict[str, np.ndarray]]:
    """The arrays of motion.npz by name of the gripper or arm."""
    groups: dict[str, dict[str, np.ndarray]] = {}
    for key, value in folder.npz(MOTION).items():
        name, slash, field = key.partition("/")
        place = f"{folder.place(MOTION)}: {key}"
        if not slash or not field:
            raise RecordingError(
                f"{place} belongs to no gripper", expected="keys like left/t", remedy="rename or remove it"
            )
        groups.setdefault(checks.name(name, place), {})[field] = value
    return groups


def _times(fields: Fields) -> np.ndarray:
    t = fields.array("t", "T")
    checks.increasing(t, fields.at("t"))
    return t


def _shared(fields: Fields) -> dict[str, Any]:
    t = _times(fields)
    return {
        "t": t,
        "closed": fields.maybe(fields.array, "closed", len(t), kind="bool"),
        "force": fields.maybe(fields.array, "force", len(t), 3),
        "torque": fields.maybe(fields.array, "torque", len(t), 3),
    }


def _pose(fields: Fields, shared: dict[str, Any]) -> dict[str, np.ndarray]:
    knots = len(shared["t"])
    position, quat = fields.array("position", knots, 3), fields.array("quat_wxyz", knots, 4)
    checks.metres(position, fields.at("position"))
    quat = checks.unit(quat, fields.at("quat_wxyz"))
    if shared["closed"] is None:
        raise RecordingError(
            f"{fields.at('closed')} is missing", expected=f"[{knots}] bool", remedy="say when the gripper holds"
        )
    return {"position": position, "quat_wxyz": quat}


def _arm(fields: Fields, knots: int) -> dict[str, Any]:
    q = fields.array("q", knots, "J")
    if q.shape[1] == 0:
        raise RecordingError(f"{fields.at('q')} has no columns", got=list(q.shape), expected="one column per joint")
    if np.abs(q).max() > LARGEST_ANGLE:
        got = f"{np.abs(q).max():.4g}"
        raise RecordingError(
            f"{fields.at('q')} looks like degrees", got=got, expected="radians", remedy="multiply by pi / 180"
        )
    width = fields.maybe(fields.array, "width", knots)
    if width is not None and width.max() > WIDEST_GRIPPER:
        got = f"{width.max():.4g}"
        raise RecordingError(
            f"{fields.at('width')} looks like millimetres", got=got, expected="metres", remedy="multiply by 0.001"
        )
    if width is not None and width.min() < -0.01:  # a closed gripper's encoder may read slightly below zero
        raise RecordingError(
            f"{fields.at('width')} is negative", got=f"{width.min():.4g}", expected="an opening in metres"
        )
    return {"q": q, "width": width}
