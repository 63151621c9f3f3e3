"""Decoding of single ROS messages to arrays.

Messages are objects with the fields of sensor_msgs and geometry_msgs.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ...errors import RecordingError
from .imported import NANOSECONDS_PER_SECOND

# encoding: (dtype, channels, whether blue comes first)
PIXEL_ENCODINGS = {
    "16UC1": ("u2", 1, False),
    "mono16": ("u2", 1, False),
    "32FC1": ("f4", 1, False),
    "mono8": ("u1", 1, False),
    "8UC1": ("u1", 1, False),
    "rgb8": ("u1", 3, False),
    "bgr8": ("u1", 3, True),
    "8UC3": ("u1", 3, True),
    "rgba8": ("u1", 4, False),
    "bgra8": ("u1", 4, True),
}
DEPTH_ENCODINGS = ("16UC1", "mono16", "32FC1")
DISTORTION_MODELS = ("plumb_bob", "rational_polynomial", "")  # models whose D is in OpenCV's order; "" has an empty D
POINT_FIELD_DTYPES = {7: "f4", 8: "f8"}
JPEG_SIGNATURE, PNG_PREFIX = b"\xff\xd8", b"\x89PNG"
MIN_STAMP_NS = 1  # a stamp of zero was never set
COMPRESSED_DEPTH_HEADER_BYTES = 12  # that the depth transport puts before its PNG


def read_stamp(message: Any, place: str) -> int:
    """Return the time of measurement [ns] in a message's header."""
    value = message.header.stamp
    ns = int(value.sec) * NANOSECONDS_PER_SECOND + int(value.nanosec)
    if ns < MIN_STAMP_NS or not 0 <= value.nanosec < NANOSECONDS_PER_SECOND:
        got = f"{value.sec} s, {value.nanosec} ns"
        raise RecordingError(f"{place} has no time stamp", got=got, remedy="set header.stamp when recording")
    return ns


def read_position(value: Any) -> np.ndarray:
    """Return a Point or Vector3 as [3]."""
    return np.array([value.x, value.y, value.z], dtype=float)


def read_quaternion(value: Any) -> np.ndarray:
    """Return a Quaternion as [4], scalar first; ROS stores it scalar last."""
    return np.array([value.w, value.x, value.y, value.z], dtype=float)


def read_pixels(message: Any, place: str) -> np.ndarray:
    """Return the pixels [H, W] or [H, W, 3] of an Image, in their own type."""
    if message.encoding not in PIXEL_ENCODINGS:
        expected = f"one of {', '.join(PIXEL_ENCODINGS)}"
        raise RecordingError(f"{place} has an unknown encoding", got=repr(message.encoding), expected=expected)
    code, channels, swapped = PIXEL_ENCODINGS[message.encoding]
    dtype = np.dtype(code).newbyteorder(">" if message.is_bigendian else "<")
    height, width, step = int(message.height), int(message.width), int(message.step)
    row = width * channels * dtype.itemsize
    data = np.asarray(message.data, dtype=np.uint8)
    if step < row or len(data) != step * height or not row:
        got = f"{len(data)} bytes, step {step}"
        raise RecordingError(f"{place} does not fill its image", got=got, expected=f"{height} rows of {row} bytes")
    rows = np.ascontiguousarray(data.reshape(height, step)[:, :row]).view(dtype)
    rows = rows.astype(dtype.newbyteorder("="))
    if channels == 1:
        return rows
    rows = rows.reshape(height, width, channels)[..., :3]
    return rows[..., ::-1] if swapped else rows


def read_compressed(message: Any, place: str) -> bytes:
    """Return the PNG or JPEG file in a CompressedImage."""
    data = bytes(message.data)
    if "compressedDepth" in message.format:
        if not message.format.startswith("16UC1"):
            raise RecordingError(f"{place} holds quantised depth", got=message.format, expected="16UC1")
        data = data[COMPRESSED_DEPTH_HEADER_BYTES:]
    if not data.startswith((JPEG_SIGNATURE, PNG_PREFIX)):
        raise RecordingError(f"{place} is neither JPEG nor PNG", got=repr(message.format))
    return data


def read_intrinsics(message: Any, place: str, *, rectified: bool) -> dict[str, Any]:
    """Return size, K and distortion of a CameraInfo in the keys of episode.json.

    For rectified images K is that of P, and there is no distortion.
    """
    if message.distortion_model not in DISTORTION_MODELS:
        expected = "plumb_bob or rational_polynomial"
        raise RecordingError(f"{place} has another lens model", got=repr(message.distortion_model), expected=expected)
    k, d, p = (getattr(message, name, getattr(message, name.upper(), None)) for name in "kdp")  # ROS 1: K, D, P
    K, P = np.asarray(k, dtype=float).reshape(3, 3), np.asarray(p, dtype=float).reshape(3, 4)
    known = {"width": int(message.width), "height": int(message.height)}
    if rectified:
        return {**known, "K": P[:, :3]}
    return {**known, "K": K, "distortion": np.asarray(d, dtype=float)}


def read_cloud(message: Any, place: str) -> np.ndarray:
    """Return the finite points [N, 3] of a PointCloud2, in the message's frame."""
    by_name = {f.name: f for f in message.fields}
    wrong = [
        n for n in "xyz" if n not in by_name or by_name[n].datatype not in POINT_FIELD_DTYPES or by_name[n].count > 1
    ]
    if wrong:
        raise RecordingError(f"{place} has no {wrong[0]}", got=sorted(by_name), expected="x, y, z as floats")
    height, width = int(message.height), int(message.width)
    step, row_step = int(message.point_step), int(message.row_step)
    data = np.asarray(message.data, dtype=np.uint8)
    ends = [int(by_name[n].offset) + np.dtype(POINT_FIELD_DTYPES[by_name[n].datatype]).itemsize for n in "xyz"]
    if max(ends) > step or row_step < width * step or len(data) != row_step * height:
        got = f"{len(data)} bytes, row_step {row_step}, point_step {step}"
        raise RecordingError(f"{place} does not fill its points", got=got, expected=f"{height} rows of {width}")
    order = ">" if message.is_bigendian else "<"
    layout: Any = {
        "names": list("xyz"),
        "formats": [order + POINT_FIELD_DTYPES[by_name[n].datatype] for n in "xyz"],
        "offsets": [int(by_name[n].offset) for n in "xyz"],
        "itemsize": step,
    }
    rows = np.ascontiguousarray(data.reshape(height, row_step)[:, : width * step]) if height else data
    points = rows.reshape(-1).view(np.dtype(layout))
    xyz = np.stack([points[n].astype(float) for n in "xyz"], axis=-1).reshape(-1, 3)
    return xyz[np.isfinite(xyz).all(axis=1)]
