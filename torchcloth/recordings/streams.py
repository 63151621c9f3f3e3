"""Conversion of the arrays of motion.npz, points.npz, markers.npz and truth.npz to the data classes of ``types``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..errors import RecordingError
from . import checks
from .checks import Fields
from .files import Folder
from .types import GripperMotion, JointMotion, Markers, PointClouds, Truth

MAX_GRIPPER_WIDTH_M = 1.0
MIN_GRIPPER_WIDTH_M = -0.01  # the encoder of a closed gripper may read slightly below zero
MAX_JOINT_ANGLE_RAD = 4 * np.pi  # no arm joint turns further; in degrees, almost any angle exceeds it
MOTION_FILE, POINTS_FILE, MARKERS_FILE, TRUTH_FILE = "motion.npz", "points.npz", "markers.npz", "truth.npz"


def parse_motions(
    groups: Mapping[str, dict[str, np.ndarray]], file: str
) -> tuple[dict[str, GripperMotion], dict[str, JointMotion]]:
    """Parse the arrays of each name into grippers and arms; one name may be both. ``file`` is for messages."""
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
            joints[name] = JointMotion(**shared, **arm, extra=fields.unknown_keys())
        if pose:
            grippers[name] = GripperMotion(**shared, **pose, extra=fields.unknown_keys())
    return grippers, joints


def parse_points(arrays: dict[str, np.ndarray], file: str) -> PointClouds:
    """Parse the arrays of the point clouds, floats in metres or int16 with a scale."""
    fields = Fields(arrays, file, ": ")
    t = _times(fields)
    counts = fields.array("counts", len(t), kind="int")
    stored = fields.take("xyz")
    compact = stored.dtype == np.int16
    if not compact and stored.dtype.kind != "f":
        raise RecordingError(
            f"{fields.location('xyz')} has the wrong dtype", got=stored.dtype, expected="float32 or int16 (+ scale)"
        )
    if compact != fields.has("scale"):
        got = f"{stored.dtype} {'with' if fields.has('scale') else 'without'} scale"
        raise RecordingError(
            f"{fields.location('scale')} does not fit xyz", got=got, expected="int16 with scale, or floats without"
        )
    xyz = checks.check_array(stored, fields.location("xyz"), ("N", 3))
    if compact:
        scale = float(fields.array("scale"))
        if scale <= 0:
            raise RecordingError(f"{fields.location('scale')} is not positive", got=scale, expected="metres per unit")
        xyz *= scale
    if counts.min() < 1:
        i = int(np.argmin(counts))
        got = f"{counts[i]} points in frame {i}"
        raise RecordingError(
            f"{fields.location('counts')} has an empty cloud",
            got=got,
            expected="at least 1",
            remedy="leave the frame out",
        )
    if counts.max() > len(xyz) or counts.sum() != len(xyz):  # the first test prevents an overflow of the sum
        got = f"counts for {sum(counts.tolist())} points, {len(xyz)} in xyz"
        raise RecordingError(
            f"{fields.location('counts')} does not match xyz", got=got, expected="sum(counts) == len(xyz)"
        )
    checks.check_metres(xyz, fields.location("xyz"))
    return PointClouds(t, xyz, counts, fields.unknown_keys())


def read_markers(folder: Folder) -> Markers:
    """Read the markers; a marker is seen whole or not at all."""
    fields = Fields(folder.read_npz(MARKERS_FILE), folder.location(MARKERS_FILE), ": ")
    t = _times(fields)
    xyz = fields.array("xyz", len(t), "M", 3, nan=True)
    unseen = np.isnan(xyz)
    if (unseen.any(axis=-1) != unseen.all(axis=-1)).any():
        raise RecordingError(
            f"{fields.location('xyz')} is half seen", got="NaN in one or two coordinates", expected="all three or none"
        )
    if unseen.all():
        raise RecordingError(
            f"{fields.location('xyz')} is empty", got="no marker seen in any frame", remedy="leave the file out"
        )
    checks.check_metres(xyz, fields.location("xyz"))
    uv = fields.optional(fields.array, "uv", xyz.shape[1], 2)
    return Markers(t, xyz, uv, fields.unknown_keys())


def read_truth(folder: Folder) -> Truth:
    """Read the true motion of a synthetic episode."""
    fields = Fields(folder.read_npz(TRUTH_FILE), folder.location(TRUTH_FILE), ": ")
    t = _times(fields)
    vertices = fields.array("vertices", len(t), "V", 3)
    checks.check_metres(vertices, fields.location("vertices"))
    faces = fields.array("faces", "F", 3, kind="int")
    if faces.size == 0 or faces.min() < 0 or faces.max() >= vertices.shape[1]:
        raise RecordingError(
            f"{fields.location('faces')} does not fit vertices", expected=f"indices below {vertices.shape[1]}"
        )
    return Truth(t, vertices, faces, fields.unknown_keys())


def read_motion_groups(folder: Folder) -> dict[str, dict[str, np.ndarray]]:
    """Read the arrays of motion.npz by name of the gripper or arm."""
    groups: dict[str, dict[str, np.ndarray]] = {}
    for key, value in folder.read_npz(MOTION_FILE).items():
        name, slash, field = key.partition("/")
        place = f"{folder.location(MOTION_FILE)}: {key}"
        if not slash or not field:
            raise RecordingError(
                f"{place} belongs to no gripper", expected="keys like left/t", remedy="rename or remove it"
            )
        groups.setdefault(checks.check_name(name, place), {})[field] = value
    return groups


def _times(fields: Fields) -> np.ndarray:
    t = fields.array("t", "T")
    checks.check_increasing(t, fields.location("t"))
    return t


def _shared(fields: Fields) -> dict[str, Any]:
    t = _times(fields)
    return {
        "t": t,
        "closed": fields.optional(fields.array, "closed", len(t), kind="bool"),
        "force": fields.optional(fields.array, "force", len(t), 3),
        "torque": fields.optional(fields.array, "torque", len(t), 3),
    }


def _pose(fields: Fields, shared: dict[str, Any]) -> dict[str, np.ndarray]:
    knots = len(shared["t"])
    position, quat = fields.array("position", knots, 3), fields.array("quat_wxyz", knots, 4)
    checks.check_metres(position, fields.location("position"))
    quat = checks.normalise_unit(quat, fields.location("quat_wxyz"))
    if shared["closed"] is None:
        raise RecordingError(
            f"{fields.location('closed')} is missing", expected=f"[{knots}] bool", remedy="say when the gripper holds"
        )
    return {"position": position, "quat_wxyz": quat}


def _arm(fields: Fields, knots: int) -> dict[str, Any]:
    q = fields.array("q", knots, "J")
    if q.shape[1] == 0:
        raise RecordingError(
            f"{fields.location('q')} has no columns", got=list(q.shape), expected="one column per joint"
        )
    if np.abs(q).max() > MAX_JOINT_ANGLE_RAD:
        got = f"{np.abs(q).max():.4g}"
        raise RecordingError(
            f"{fields.location('q')} looks like degrees", got=got, expected="radians", remedy="multiply by pi / 180"
        )
    width = fields.optional(fields.array, "width", knots)
    if width is not None and width.max() > MAX_GRIPPER_WIDTH_M:
        got = f"{width.max():.4g}"
        raise RecordingError(
            f"{fields.location('width')} looks like millimetres", got=got, expected="metres", remedy="multiply by 0.001"
        )
    if width is not None and width.min() < MIN_GRIPPER_WIDTH_M:
        raise RecordingError(
            f"{fields.location('width')} is negative", got=f"{width.min():.4g}", expected="an opening in metres"
        )
    return {"q": q, "width": width}
