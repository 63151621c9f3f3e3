"""Checks of single values. Each takes the place it looks at (file and key), so that a refusal can name it."""

from __future__ import annotations

import math
import re
import reprlib
from collections.abc import Callable
from difflib import get_close_matches
from typing import Any, Concatenate, Literal, ParamSpec, TypeVar

import numpy as np

from ..errors import RecordingError

LARGEST_SCENE = 20.0  # m; no cloth experiment spans more, and the same number in millimetres is a handkerchief
FARTHEST_BASE = 100.0  # m; a base or camera may stand far from a map's origin, but not that far
LONGEST_EPISODE = 86_400.0  # s
HUGE = 1e100  # stands for infinity: nothing physical comes near, and squares of smaller numbers stay finite
UNIT_TOLERANCE = 1e-3  # quaternions and rotations are often stored as float32 or with four digits
EXACT = 1e-9  # of R R^T or a length: nothing was rounded
ALIKE = 0.8  # of two keys, as difflib measures it: one of them is misspelt

_KINDS = {"float": ("iuf", np.float64), "int": ("iu", np.int64), "bool": ("b", np.bool_)}
_NAME = re.compile(r"[^./\\\x00][^/\\\x00]*")

P = ParamSpec("P")
R = TypeVar("R")


def array(
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
        kind: what the numbers are; whole numbers pass as "float".
        nan: whether NaN is accepted, for "not seen".
    """
    letters, dtype = _KINDS[kind]
    try:
        data = np.asarray(value)
    except ValueError as error:
        raise RecordingError(f"{place} is not a rectangular array", got=reprlib.repr(value)) from error
    if data.dtype.kind not in letters:
        raise RecordingError(
            f"{place} has the wrong dtype", got=data.dtype, expected=kind, remedy="convert and rewrite it"
        )
    if data.ndim != len(shape) or any(isinstance(n, int) and n != m for n, m in zip(shape, data.shape, strict=True)):
        raise RecordingError(
            f"{place} has the wrong shape", got=list(data.shape), expected=f"[{', '.join(map(str, shape))}]"
        )
    data = data.astype(dtype)
    bad = ~(np.abs(data) < HUGE) if kind == "float" else np.zeros(data.shape, dtype=bool)
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


def increasing(t: np.ndarray, place: str) -> None:
    """Refuse times [N] s that are empty, repeat, run backwards, or are plainly not seconds."""
    if t.size == 0:
        raise RecordingError(f"{place} is empty", expected="at least one time", remedy="leave the stream out instead")
    if (np.diff(t) <= 0).any():
        i = int(np.argmax(np.diff(t) <= 0))
        got = f"{t[i]:.9g} then {t[i + 1]:.9g} at sample {i + 1}"
        raise RecordingError(
            f"{place} does not increase", got=got, expected="strictly increasing seconds", remedy="sort or drop samples"
        )
    if t[-1] - t[0] > LONGEST_EPISODE:
        got = f"a duration of {t[-1] - t[0]:.4g}"
        raise RecordingError(
            f"{place} looks like milli- or nanoseconds", got=got, expected="seconds", remedy="rescale it"
        )


def metres(points: np.ndarray, place: str) -> None:
    """Refuse coordinates [..., D] whose extent can only be millimetres; rows with NaN do not count."""
    rows = points.reshape(-1, points.shape[-1])
    rows = rows[~np.isnan(rows).any(axis=1)]
    span = float(np.ptp(rows, axis=0).max()) if len(rows) else 0.0
    if span > LARGEST_SCENE:
        got = f"a span of {span:.4g}"
        raise RecordingError(f"{place} looks like millimetres", got=got, expected="metres", remedy="multiply by 0.001")


def unit(vectors: np.ndarray, place: str) -> np.ndarray:
    """Vectors or quaternions [..., D] of length one; those that were stored with few digits are made so.

    Raises:
        RecordingError: they are none.
    """
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    off = np.abs(length - 1)
    if off.max() > UNIT_TOLERANCE:
        worst = int(np.argmax(off))
        got = f"length {length.reshape(-1)[worst]:.6g} at sample {worst}"
        raise RecordingError(f"{place} is not unit", got=got, expected="length 1", remedy="normalise it")
    return np.where(off < EXACT, vectors, vectors / length)


def transform(matrix: np.ndarray, place: str) -> np.ndarray:
    """A rigid motion in metres [4, 4]; one that was stored with few digits is rounded to the nearest rotation.

    Raises:
        RecordingError: it is none.
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
    if np.abs(matrix[:3, 3]).max() > FARTHEST_BASE:
        got = matrix[:3, 3].tolist()
        raise RecordingError(f"{place} looks like millimetres", got=got, expected="metres", remedy="multiply by 0.001")
    if error < EXACT:
        return matrix
    left, _, right = np.linalg.svd(rotation)
    rigid = matrix.copy()
    rigid[:3, :3] = left @ right
    return rigid


def name(value: str, place: str) -> str:
    """Return a name that is safe as a file name and as an NPZ prefix."""
    if not _NAME.fullmatch(value):
        expected = "one name without slashes that does not begin with a dot"
        raise RecordingError(f"{place} is not a plain name", got=repr(value), expected=expected, remedy="rename it")
    return value


class Fields:
    """Takes the keys of one mapping (JSON object or NPZ group) and remembers where it is and what was not taken.

    The takers raise when a key is missing; ``maybe`` makes any of them optional (JSON null counts as missing).
    """

    def __init__(self, value: Any, place: str, joint: str = ".") -> None:
        if not isinstance(value, dict):
            raise RecordingError(f"{place} is not an object of named values", got=reprlib.repr(value))
        self.place, self._joint, self.rest, self._given = place, joint, dict(value), set(value)
        self.asked: list[str] = []  # every key that was looked for

    def at(self, key: str) -> str:
        """File and key, for messages."""
        return f"{self.place}{self._joint}{key}"

    def has(self, key: str) -> bool:
        """Whether the key is there and not null."""
        self._ask(key)
        return self.rest.get(key) is not None

    def _ask(self, key: str) -> None:
        if key not in self.asked:
            self.asked.append(key)

    def take(self, key: str) -> Any:
        """The raw value."""
        self._ask(key)
        value = self.rest.pop(key, None)
        if value is None:
            raise RecordingError(f"{self.at(key)} is missing", remedy="add it, see the recording format")
        return value

    def maybe(self, taker: Callable[Concatenate[str, P], R], key: str, *args: P.args, **kwargs: P.kwargs) -> R | None:
        """What ``taker`` gives for the key, or None when it is missing."""
        if self.has(key):
            return taker(key, *args, **kwargs)
        self.rest.pop(key, None)
        return None

    def number(
        self,
        key: str,
        *,
        least: float = -math.inf,
        above: float = -math.inf,
        most: float = math.inf,
        suspect: str = "",
    ) -> float:
        """A finite number within bounds; beyond ``most`` it looks like the ``suspect`` unit."""
        value = self.take(key)
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < HUGE:
            raise RecordingError(f"{self.at(key)} is not a finite number", got=reprlib.repr(value), expected="a number")
        if value > most:
            raise RecordingError(
                f"{self.at(key)} looks like {suspect}", got=value, expected=f"at most {most:g}", remedy="use SI units"
            )
        if value < least or value <= above:
            expected = f"at least {least:g}" if value < least else f"more than {above:g}"
            raise RecordingError(f"{self.at(key)} is too small", got=value, expected=expected, remedy="correct it")
        return float(value)

    def whole(self, key: str) -> int:
        """A positive whole number."""
        value = self.number(key, above=0)
        if value != int(value):
            raise RecordingError(f"{self.at(key)} is not whole", got=value, expected="a whole number")
        return int(value)

    def text(self, key: str) -> str:
        """A non-empty string."""
        value = self.take(key)
        if not isinstance(value, str) or not value:
            raise RecordingError(f"{self.at(key)} is not text", got=reprlib.repr(value), expected="a non-empty string")
        return value

    def array(
        self, key: str, *shape: int | str, kind: Literal["float", "int", "bool"] = "float", nan: bool = False
    ) -> np.ndarray:
        """An array, see `array`."""
        return array(self.take(key), self.at(key), shape, kind, nan=nan)

    def inside(self, key: str) -> Fields:
        """The object under the key; an absent one is empty."""
        self._ask(key)
        value = self.rest.pop(key, None)
        return Fields({} if value is None else value, self.at(key))

    def each(self, key: str) -> dict[str, Fields]:
        """The named objects under the key."""
        group = self.inside(key)
        return {name(k, f"{group.place} name"): group.inside(k) for k in list(group.rest)}

    def left(self, **groups: Fields) -> dict[str, Any]:
        """What nobody took, here and, under their own names, in the small groups inside.

        Raises:
            RecordingError: a key that is nearly one that is looked for and not there: misspelt, it would be ignored.
        """
        absent = [key for key in self.asked if key not in self._given]
        for key in self.rest:
            if meant := get_close_matches(key, absent, 1, ALIKE):
                raise RecordingError(
                    f"{self.at(key)} is unknown", got=repr(key), expected=repr(meant[0]), remedy="rename it"
                )
        inside = {key: group.left() for key, group in groups.items()}
        return {**self.rest, **{key: rest for key, rest in inside.items() if rest}}
