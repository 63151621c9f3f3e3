"""Calibration of a camera in files of other tools: the intrinsics as JSON, and a pose as text."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import RecordingError
from .. import checks
from .imported import MAX_SHOWN_CHARACTERS, read_text, to_pose_matrices
from .ros2_messages import DISTORTION_MODELS

MATRIX_KEYS = ("K", "k", "camera_matrix", "intrinsic_matrix", "intrinsics", "matrix")
DISTORTION_KEYS = ("D", "d", "distortion", "distortion_coefficients", "dist", "dist_coeffs", "coeffs")
MODEL_KEYS = ("distortion_model", "model")
WIDTH_KEYS, HEIGHT_KEYS = ("width", "image_width", "w"), ("height", "image_height", "h")
FOCAL_KEYS = (("fx", "fy", "cx", "cy"), ("fx", "fy", "ppx", "ppy"))
DEPTH_SCALE_KEY, MIN_DEPTH_SCALE_M = "depth_scale", 1e-9
CAMERA_MATRIX_FORMS = '"fx", "fy", "cx", "cy"; or "K" as 3 rows or 9 numbers; or a CameraInfo of ROS'


def read_intrinsics(path: Path) -> dict[str, Any]:
    """Read the intrinsics of a camera in the keys of episode.json.

    K is always there; width, height, distortion and depth_scale are there if the file gives them.

    Args:
        path: JSON with fx, fy, cx, cy; a 3 x 3 matrix; or the fields of a CameraInfo of ROS.

    Raises:
        RecordingError: the file holds no camera matrix, or another lens model than OpenCV's.
    """
    try:
        content = json.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        if isinstance(error, RecordingError):
            raise
        raise RecordingError(f"{path} is no JSON", got=error, expected=CAMERA_MATRIX_FORMS) from error
    values = content if isinstance(content, dict) else {MATRIX_KEYS[0]: content}
    nested = next((v for v in values.values() if isinstance(v, dict) and _has_matrix(v)), None)
    if not _has_matrix(values) and nested is not None:  # e.g. {"depth": {"fx": ...}}
        values = nested
    known: dict[str, Any] = {"K": _read_matrix(values, path)}
    for key, names in (("width", WIDTH_KEYS), ("height", HEIGHT_KEYS)):
        number = _first(values, names)
        if number is not None:
            is_number = isinstance(number, int | float) and not isinstance(number, bool)
            if not (is_number and 1 <= number < math.inf and number == int(number)):
                raise RecordingError(f"{path}: {key}", got=number, expected="a whole number of pixels")
            known[key] = int(number)
    distortion = _data(_first(values, DISTORTION_KEYS))
    if distortion is not None:
        coefficients = checks.check_array(np.ravel(distortion).tolist(), f"{path}: distortion", ("N",))
        model = str(_first(values, MODEL_KEYS) or "").lower()
        if coefficients.any() and model not in DISTORTION_MODELS and "brown" not in model:
            expected = "plumb_bob or rational_polynomial, in OpenCV's order"
            raise RecordingError(f"{path} has another lens model", got=repr(model), expected=expected)
        if coefficients.any() and "inverse" in model:
            raise RecordingError(f"{path} has another lens model", got=repr(model), remedy="rectify the images")
        known["distortion"] = coefficients
    scale = values.get(DEPTH_SCALE_KEY)
    if scale is not None:
        is_number = isinstance(scale, int | float) and not isinstance(scale, bool)
        if not (is_number and MIN_DEPTH_SCALE_M < scale < 1 / MIN_DEPTH_SCALE_M):
            raise RecordingError(
                f"{path}: {DEPTH_SCALE_KEY}", got=scale, expected="metres per unit, or units per metre"
            )
        known[DEPTH_SCALE_KEY] = 1 / scale if scale > 1 else float(scale)  # Open3D stores units per metre
    return known


def read_pose(path: Path) -> np.ndarray:
    """Read a pose [4, 4] in metres: 4 x 4 or 3 x 4 numbers row by row, or x y z qx qy qz qw.

    Raises:
        RecordingError: another number of numbers, or no rigid pose.
    """
    lines = [line.split("#")[0] for line in read_text(path).splitlines()]
    words = re.sub(r"[\[\](),;{}:=]", " ", " ".join(lines)).split()
    try:
        numbers = np.array([float(word) for word in words])
    except ValueError as error:
        got = next(repr(word[:MAX_SHOWN_CHARACTERS]) for word in words if not _is_number(word))
        raise RecordingError(f"{path} is no pose", got=got, expected="numbers only") from error
    if len(numbers) == 7:
        checks.check_array(numbers, str(path), (7,))
        quaternion = numbers[None, [6, 3, 4, 5]]
        return checks.check_transform(to_pose_matrices(numbers[None, :3], quaternion, str(path))[0], str(path))
    if len(numbers) not in (12, 16):
        expected = "16 (4 x 4), 12 (3 x 4) or 7 (x y z qx qy qz qw)"
        raise RecordingError(f"{path} is no pose", got=f"{len(numbers)} numbers", expected=expected)
    matrix = np.vstack([numbers.reshape(-1, 4), [[0.0, 0.0, 0.0, 1.0]]])[:4]
    return checks.check_transform(checks.check_array(matrix, str(path), (4, 4)), str(path))


def _has_matrix(values: dict[str, Any]) -> bool:
    return any(key in values for key in MATRIX_KEYS) or any(set(keys) <= values.keys() for keys in FOCAL_KEYS)


def _read_matrix(values: dict[str, Any], path: Path) -> np.ndarray:
    keys = next((keys for keys in FOCAL_KEYS if set(keys) <= values.keys()), None)
    given = _data(_first(values, MATRIX_KEYS))
    if keys is not None:
        fx, fy, cx, cy = checks.check_array([values[key] for key in keys], f"{path}: {', '.join(keys)}", (4,)).tolist()
        matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    elif isinstance(given, dict):
        return _read_matrix(given, path)
    elif given is None:
        got = ", ".join(map(str, values))[:MAX_SHOWN_CHARACTERS]
        raise RecordingError(f"{path} holds no camera matrix", got=got, expected=CAMERA_MATRIX_FORMS)
    else:
        flat = checks.check_array(np.ravel(np.asarray(given, dtype=object)).tolist(), f"{path}: camera matrix", (9,))
        matrix = flat.reshape(3, 3)
        if np.array_equal(matrix[:, 2], [0, 0, 1]) and matrix[2, :2].all():  # column by column, as Open3D writes it
            matrix = matrix.T
    if min(matrix[0, 0], matrix[1, 1]) <= 0 or not np.array_equal(matrix[[1, 2, 2, 2], [0, 0, 1, 2]], [0, 0, 0, 1]):
        expected = "[[fx, s, cx], [0, fy, cy], [0, 0, 1]] in pixels"
        raise RecordingError(f"{path} holds no camera matrix", got=matrix.tolist(), expected=expected)
    return matrix


def _data(value: Any) -> Any:
    """The numbers of a matrix that OpenCV wrote as {rows, cols, data}."""
    return value["data"] if isinstance(value, dict) and "data" in value else value


def _first(values: dict[str, Any], keys: tuple[str, ...]) -> Any:
    return next((values[key] for key in keys if values.get(key) is not None), None)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
