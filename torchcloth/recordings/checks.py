"""Checks of single values. Each takes the location (file and key) of the value for its message."""

from __future__ import annotations

import math
import re
import reprlib
from collections.abc import Callable
from difflib import get_close_matches
from typing import Any, Concatenate, Literal, ParamSpec, TypeVar

import numpy as np

from ..errors import RecordingError, has_control_characters

MAX_SCENE_EXTENT_M = 20.0  # no cloth experiment spans more; the same number in millimetres is a handkerchief
MAX_BASE_DISTANCE_M = 100.0  # of a base or camera from a map's origin
MAX_EPISODE_DURATION_S = 86_400.0
MAX_EPOCH_S = 1e11  # since 1970; the year 5138
EPOCH_UNITS = {  # limit that stamps of this century are below, and how many units a second has
    "milliseconds": (1e14, 1e3),
    "microseconds": (1e17, 1e6),
    "nanoseconds": (np.inf, 1e9),
}
MAX_FINITE_VALUE = 1e100  # larger values count as infinite; squares of smaller ones stay finite
UNIT_TOLERANCE = 1e-3  # quaternions and rotations are often stored as float32 or with four digits
ROUNDING_TOLERANCE = 1e-9  # of R R^T or a length, below which the stored value is used as it is
MIN_MISSPELLING_SIMILARITY = 0.8  # of two keys (difflib), above which one of them is a misspelling


_DTYPES_BY_KIND = {"float": ("iuf", np.float64), "int": ("iu", np.int64), "bool": ("b", np.bool_)}
_PLAIN_NAME_PATTERN = re.compile(r"[^./\\\x00][^/\\\x00]*")

P = ParamSpec("P")
R = TypeVar("R")


def check_array(
    value: Any,
    place: str,
    shape: tuple[int | str, ...],
    kind: Literal["float", "int", "bool"] = "float",
    *,
    nan: bool = False,
) -> np.ndarray:
    """Return ``value`` as an array of the kind's widest type.

    Args:
        value: array or nested list.
        place: file and key, for messages.
        shape: sizes that must match; a letter stands for any size.
        kind: type of the numbers; integers are accepted as "float".
        nan: whether NaN is accepted, for "not seen".

    Raises:
        RecordingError: another shape or type, or numbers that are not finite.
    """
    letters, dtype = _DTYPES_BY_KIND[kind]
    try:
        data = np.asarray(value)
    except ValueError as error:
        raise RecordingError(f"{place} is not a rectangular array", got=reprlib.repr(value)) from error
    if data.dtype.kind not in letters:
        raise RecordingError(
            f"{place} has the wrong dtype", got=data.dtype, expected=kind, remedy="convert and rewrite it"
        )
    if kind != "bool" and isinstance(value, list) and _has_bool(value):  # numpy would count true as 1
        raise RecordingError(f"{place} has the wrong dtype", got="true or false among numbers", expected=kind)
    if data.ndim != len(shape) or any(isinstance(n, int) and n != m for n, m in zip(shape, data.shape, strict=True)):
        raise RecordingError(
            f"{place} has the wrong shape", got=list(data.shape), expected=f"[{', '.join(map(str, shape))}]"
        )
    with np.errstate(invalid="ignore"):  # of a signalling NaN, which is refused below
        data = data.astype(dtype)
    bad = ~(np.abs(data) < MAX_FINITE_VALUE) if kind == "float" else np.zeros(data.shape, dtype=bool)
    bad &= ~(np.isnan(data) & nan)
    if bad.any():
        where = [int(i) for i in np.argwhere(bad)[0]]
        raise RecordingError(
            f"{place} is not finite",
            got=f"{data[bad][0]} at {where}",
            expected="numbers",
            remedy="drop or repair that sample",
        )
    return data


def _has_bool(values: list) -> bool:
    """Whether a nested list of JSON has true or false in it."""
    return any(_has_bool(value) if isinstance(value, list) else isinstance(value, bool) for value in values)


def check_increasing(t: np.ndarray, place: str) -> None:
    """Refuse times [N] s that are empty, repeat, decrease, or are obviously not seconds.

    Raises:
        RecordingError: names the first wrong sample.
    """
    if t.size == 0:
        raise RecordingError(f"{place} is empty", expected="at least one time", remedy="leave the stream out instead")
    if not np.isfinite(t[0]):
        raise RecordingError(f"{place} is no time", got=f"{t[0]:g}", expected="seconds")
    if abs(t[0]) > MAX_EPOCH_S:
        unit, per_second = next((name, n) for name, (limit, n) in EPOCH_UNITS.items() if abs(t[0]) < limit)
        remedy = f"divide the stamps by {per_second:g}"
        raise RecordingError(f"{place} looks like {unit}", got=f"{t[0]:.13g}", expected="seconds", remedy=remedy)
    if (np.diff(t) <= 0).any():
        i = int(np.argmax(np.diff(t) <= 0))
        got = f"{t[i]:.9g} then {t[i + 1]:.9g} at sample {i + 1}"
        raise RecordingError(
            f"{place} does not increase", got=got, expected="strictly increasing seconds", remedy="sort or drop samples"
        )
    if t[-1] - t[0] > MAX_EPISODE_DURATION_S:
        got = f"a duration of {t[-1] - t[0]:.4g}"
        raise RecordingError(
            f"{place} looks like milli- or nanoseconds", got=got, expected="seconds", remedy="rescale it"
        )


def check_metres(points: np.ndarray, place: str) -> None:
    """Refuse coordinates [..., D] whose extent can only be millimetres; rows with NaN do not count.

    Raises:
        RecordingError: the extent is above 20 m.
    """
    rows = points.reshape(-1, points.shape[-1])
    rows = rows[~np.isnan(rows).any(axis=1)]
    span = float(np.ptp(rows, axis=0).max()) if len(rows) else 0.0
    if span > MAX_SCENE_EXTENT_M:
        got = f"a span of {span:.4g}"
        raise RecordingError(f"{place} looks like millimetres", got=got, expected="metres", remedy="multiply by 0.001")


def normalise_unit(vectors: np.ndarray, place: str) -> np.ndarray:
    """Return vectors or quaternions [..., D] of length one; those that were stored with few digits are normalised.

    Raises:
        RecordingError: a length differs from one by more than ``UNIT_TOLERANCE``.
    """
    with np.errstate(over="ignore"):  # a length that overflows is not one
        length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    off = np.abs(length - 1)
    if off.max() > UNIT_TOLERANCE:
        worst = int(np.argmax(off))
        got = f"length {length.reshape(-1)[worst]:.6g} at sample {worst}"
        raise RecordingError(f"{place} is not unit", got=got, expected="length 1", remedy="normalise it")
    return np.where(off < ROUNDING_TOLERANCE, vectors, vectors / length)


def check_transform(matrix: np.ndarray, place: str) -> np.ndarray:
    """Return a rigid transform [4, 4] in metres.

    One that was stored with few digits is projected to the nearest rotation.

    Raises:
        RecordingError: the matrix is not rigid.
    """
    rotation = matrix[:3, :3]
    error = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if error > UNIT_TOLERANCE or np.linalg.det(rotation) < 0:
        got = f"R R^T off by {error:.3g}, det {np.linalg.det(rotation):.3g}"
        raise RecordingError(
            f"{place} is not a rotation", got=got, expected="orthonormal, det 1", remedy="calibrate again"
        )
    if not np.array_equal(matrix[3], [0, 0, 0, 1]):
        got = matrix[3].tolist()
        raise RecordingError(
            f"{place} has a wrong last row", got=got, expected="[0, 0, 0, 1]", remedy="store it row by row"
        )
    if np.abs(matrix[:3, 3]).max() > MAX_BASE_DISTANCE_M:
        got = matrix[:3, 3].tolist()
        raise RecordingError(f"{place} looks like millimetres", got=got, expected="metres", remedy="multiply by 0.001")
    if error < ROUNDING_TOLERANCE:
        return matrix
    left, _, right = np.linalg.svd(rotation)
    rigid = matrix.copy()
    rigid[:3, :3] = left @ right
    return rigid


def check_name(value: str, place: str) -> str:
    """Return a name that is safe as a file name, as an NPZ prefix and on a terminal.

    Raises:
        RecordingError: it has slashes or control characters, or begins with a dot.
    """
    check_printable(value, place)
    if not _PLAIN_NAME_PATTERN.fullmatch(value):
        expected = "one name without slashes that does not begin with a dot"
        raise RecordingError(f"{place} is not a plain name", got=repr(value), expected=expected, remedy="rename it")
    return value


def check_printable(text: str, place: str) -> str:
    """Return a text that can be printed as it is.

    Raises:
        RecordingError: it has control characters, such as escape sequences of a terminal.
    """
    if has_control_characters(text):
        expected = "no control characters"
        raise RecordingError(
            f"{place} is not a plain name or text", got=repr(text), expected=expected, remedy="rename it"
        )
    return text


class Fields:
    """The keys of one mapping (JSON object or NPZ group), its location, and which keys were not taken.

    Methods that take a key raise if it is missing; ``optional`` makes any of them optional (JSON null counts as
    missing).

    Attributes:
        place: file and path of the mapping, for messages.
        remaining: keys and values that were not taken yet.
        requested: every key that was asked for.
    """

    def __init__(self, value: Any, place: str, joint: str = ".") -> None:
        if not isinstance(value, dict):
            raise RecordingError(f"{place} is not an object of named values", got=reprlib.repr(value))
        self.place, self._joint, self.remaining, self._given = place, joint, dict(value), set(value)
        self.requested: list[str] = []

    def location(self, key: str) -> str:
        """Return file and key, for messages."""
        return f"{self.place}{self._joint}{key}"

    def has(self, key: str) -> bool:
        """Return whether the key is there and not null."""
        self._request(key)
        return self.remaining.get(key) is not None

    def _request(self, key: str) -> None:
        if key not in self.requested:
            self.requested.append(key)

    def take(self, key: str) -> Any:
        """Take the raw value of a key.

        Raises:
            RecordingError: the key is missing.
        """
        self._request(key)
        value = self.remaining.pop(key, None)
        if value is None:
            raise RecordingError(f"{self.location(key)} is missing", remedy="add it, see the recording format")
        return value

    def optional(
        self, taker: Callable[Concatenate[str, P], R], key: str, *args: P.args, **kwargs: P.kwargs
    ) -> R | None:
        """Return the result of ``taker`` for the key, or None if the key is missing."""
        if self.has(key):
            return taker(key, *args, **kwargs)
        self.remaining.pop(key, None)
        return None

    def number(
        self,
        key: str,
        *,
        minimum: float = -math.inf,
        above: float = -math.inf,
        maximum: float = math.inf,
        suspect: str = "",
    ) -> float:
        """Take a finite number within bounds; above ``maximum`` it looks like the unit ``suspect``.

        Raises:
            RecordingError: no such number.
        """
        value = self.take(key)
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < MAX_FINITE_VALUE:
            raise RecordingError(
                f"{self.location(key)} is not a finite number", got=reprlib.repr(value), expected="a number"
            )
        if value > maximum:
            raise RecordingError(
                f"{self.location(key)} looks like {suspect}",
                got=value,
                expected=f"at most {maximum:g}",
                remedy="use SI units",
            )
        if value < minimum or value <= above:
            expected = f"at least {minimum:g}" if value < minimum else f"more than {above:g}"
            raise RecordingError(
                f"{self.location(key)} is too small", got=value, expected=expected, remedy="correct it"
            )
        return float(value)

    def whole_number(self, key: str) -> int:
        """Take a positive integer."""
        value = self.number(key, above=0)
        if value != int(value):
            raise RecordingError(f"{self.location(key)} is not whole", got=value, expected="a whole number")
        return int(value)

    def text(self, key: str) -> str:
        """Take a non-empty string."""
        value = self.take(key)
        if not isinstance(value, str) or not value:
            raise RecordingError(
                f"{self.location(key)} is not text", got=reprlib.repr(value), expected="a non-empty string"
            )
        return check_printable(value, self.location(key))

    def array(
        self, key: str, *shape: int | str, kind: Literal["float", "int", "bool"] = "float", nan: bool = False
    ) -> np.ndarray:
        """Take an array, see ``check_array``."""
        return check_array(self.take(key), self.location(key), shape, kind, nan=nan)

    def group(self, key: str) -> Fields:
        """Take the object under the key; a missing one is empty."""
        self._request(key)
        value = self.remaining.pop(key, None)
        return Fields({} if value is None else value, self.location(key))

    def named_groups(self, key: str) -> dict[str, Fields]:
        """Take the named objects under the key."""
        group = self.group(key)
        return {check_name(k, f"{group.place} name"): group.group(k) for k in list(group.remaining)}

    def unknown_keys(self, **groups: Fields) -> dict[str, Any]:
        """Return the keys that were not taken, here and, under their own names, in the small groups in_groups.

        Raises:
            RecordingError: a key resembles a known one that is absent: as a typo it would be ignored.
        """
        absent = [key for key in self.requested if key not in self._given]
        for key in self.remaining:
            if suggestions := get_close_matches(key, absent, 1, MIN_MISSPELLING_SIMILARITY):
                raise RecordingError(
                    f"{self.location(key)} is unknown", got=repr(key), expected=repr(suggestions[0]), remedy="rename it"
                )
        in_groups = {key: group.unknown_keys() for key, group in groups.items()}
        return {**self.remaining, **{key: unknown for key, unknown in in_groups.items() if unknown}}
