"""What an importer hands over, and the small tools that importers share."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import MissingDependency, RecordingError, TorchclothError
from .. import checks
from ..checks import Fields
from ..images import ImageSource, ImageStream, Kind, pillow

LONGEST_NAME = 60  # of a value shown in a message
NANO = 10**9
LEAST, MOST = 0.05, 30.0  # m; where half of all depths lie
TOGETHER = 20_000_000  # ns between two images taken as one frame, as TUM's associate.py has it


@dataclass
class ImportedCamera:
    """One camera of the file: what it says in the words of episode.json, and its images."""

    known: dict[str, Any] = field(default_factory=dict)
    streams: dict[Kind, ImageStream] = field(default_factory=dict)
    placed_by: str | None = None  # another camera, whose pose in the scene also places this one


@dataclass
class Imported:
    """Everything that a file of another format says; the scene adds the rest."""

    motion: dict[str, dict[str, np.ndarray]] = field(default_factory=dict)  # by name, as the groups of motion.npz
    points: dict[str, np.ndarray] | None = None  # as in points.npz
    cameras: dict[str, ImportedCamera] = field(default_factory=dict)
    held: dict[str, Any] = field(default_factory=dict)  # further streams, by the names of `Recording`
    notes: dict[str, Any] = field(default_factory=dict)  # where it is from; kept as "source" in the episode


class FileImages(ImageSource):
    """Image files of another layout, read and checked when they are copied into the episode."""

    def __init__(self, paths: Sequence[Path]) -> None:
        self.paths = tuple(paths)

    def __iter__(self) -> Iterator[bytes]:
        for path in self.paths:
            yield file_bytes(path)

    def file(self, i: int) -> Path:
        """The file of image ``i``."""
        return self.paths[i]


def file_bytes(path: Path) -> bytes:
    """The bytes of a file that must be there."""
    try:
        return path.read_bytes()
    except (OSError, ValueError) as error:  # ValueError: a name that no file system can hold
        reason = getattr(error, "strerror", None) or error
        raise RecordingError(f"{path} cannot be read", got=reason, expected="a readable file") from error


def file_text(path: Path) -> str:
    """The text of a UTF-8 file."""
    try:
        return file_bytes(path).decode()
    except UnicodeDecodeError as error:
        raise RecordingError(f"{path} is not UTF-8 text", got=error.reason, remedy="restore it") from error


@contextmanager
def damaged(path: Path | str, what: str, *, remedy: str = "record or copy it again") -> Iterator[None]:
    """Turn whatever a library raises over a damaged file into one `RecordingError`."""
    try:
        yield
    except (TorchclothError, MissingDependency):
        raise
    except Exception as error:  # decoders raise what they please: struct, key, assertion, memory, their own
        got = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise RecordingError(f"{path} is no sound {what}", got=got, remedy=remedy) from error


def image_size(path: Path | bytes) -> tuple[int, int]:
    """(width, height) in the head of a PNG or JPEG file."""
    place = path if isinstance(path, Path) else "an image"
    data = path if isinstance(path, bytes) else file_bytes(path)
    with damaged(place, "image"), pillow().open(io.BytesIO(data)) as image:
        return image.size


def plausible(depth: ImageStream, scale: float, path: Path) -> None:
    """Refuse depths that lie beyond any cloth experiment in the unit that was assumed."""
    seen = depth.load(0)
    middle = float(np.median(seen[seen > 0])) * scale if (seen > 0).any() else 1.0
    if not LEAST < middle < MOST:
        got, remedy = f"a median depth of {middle:.3g} m", "set cameras.NAME.depth_scale in the scene"
        raise RecordingError(f"{path} is not in units of {scale:g} m", got=got, expected="0.05 to 30 m", remedy=remedy)


def seconds(nanoseconds: Sequence[int] | np.ndarray, start: int) -> np.ndarray:
    """Times [N] s since ``start``, each the float64 nearest to its whole nanoseconds."""
    return (np.asarray(nanoseconds, dtype=np.int64) - start) / NANO


def nanoseconds(text: str, place: str) -> int:
    """Whole nanoseconds of a decimal number of seconds, without going through a float."""
    from decimal import Decimal, InvalidOperation

    try:
        value = Decimal(text) * NANO
        if not value.is_finite() or abs(value) > 2**62:
            raise InvalidOperation
        return int(value)
    except ArithmeticError as error:  # it overflows, too
        raise RecordingError(f"{place} is no time", got=repr(text[:LONGEST_NAME]), expected="seconds") from error


def fixed_pose(
    poses: np.ndarray, place: str, *, metres: float = 2e-3, radians: float = 4e-3, remedy: str = ""
) -> np.ndarray:
    """The one pose [4, 4] of a camera that stood still for all of ``poses`` [N, 4, 4]; a moving one is refused."""
    poses = np.stack([checks.transform(pose, place) for pose in poses])
    first = poses[0]
    moved = np.linalg.norm(poses[:, :3, 3] - first[:3, 3], axis=1).max()
    traces = np.einsum("ij,nij->n", first[:3, :3], poses[:, :3, :3])
    turned = math.acos(float(np.clip((traces.min() - 1) / 2, -1, 1)))
    if moved > metres or turned > radians:
        got = f"{moved:.3g} m and {math.degrees(turned):.3g} degrees"
        expected = "a camera that stands still, an episode holds one pose for it"
        raise RecordingError(f"{place} moves", got=got, expected=expected, remedy=remedy)
    return first


def pose_matrix(position: np.ndarray, quat_wxyz: np.ndarray, place: str) -> np.ndarray:
    """Poses [N, 4, 4] from positions [N, 3] m and unit quaternions [N, 4]."""
    checks.unit(quat_wxyz, place)
    w, x, y, z = (quat_wxyz / np.linalg.norm(quat_wxyz, axis=1, keepdims=True)).T
    out = np.tile(np.eye(4), (len(position), 1, 1))
    out[:, :3, :3] = np.moveaxis(
        np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        ),
        -1,
        0,
    )
    out[:, :3, 3] = position
    return out


def quaternions(matrices: np.ndarray) -> np.ndarray:
    """Unit quaternions [N, 4] scalar first of rotations [N, 3, 3] (Bar-Itzhack 2000; sound at half turns too)."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = np.moveaxis(matrices, 0, -1)
    rows = [
        [xx + yy + zz, zy - yz, xz - zx, yx - xy],
        [zy - yz, xx - yy - zz, xy + yx, xz + zx],
        [xz - zx, xy + yx, yy - xx - zz, yz + zy],
        [yx - xy, xz + zx, yz + zy, zz - xx - yy],
    ]
    quat = np.linalg.eigh(np.moveaxis(np.array(rows), -1, 0))[1][..., -1]
    return quat * np.where(quat[:, :1] < 0, -1.0, 1.0)


def frame_numbers(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Frame numbers of two streams by their times [ns]: two images that are each other's nearest share one."""
    to_b, to_a = _nearest(a, b), _nearest(b, a)
    paired = {i: int(j) for i, j in enumerate(to_b) if to_a[j] == i and abs(int(a[i]) - int(b[j])) <= TOGETHER}
    partners = {j: i for i, j in paired.items()}
    events = [(min(int(a[i]), int(b[j])), i, j) for i, j in paired.items()]
    events += [(int(t), i, None) for i, t in enumerate(a) if i not in paired]
    events += [(int(t), None, j) for j, t in enumerate(b) if j not in partners]
    first, second = np.zeros(len(a), dtype=np.int64), np.zeros(len(b), dtype=np.int64)
    for number, (_, i, j) in enumerate(sorted(events, key=lambda event: event[0])):
        if i is not None:
            first[i] = number
        if j is not None:
            second[j] = number
    return first, second


def _nearest(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Index into ``b`` of the time nearest to each of ``a``."""
    right = np.clip(np.searchsorted(b, a), 1, max(len(b) - 1, 1))
    left = right - 1
    right = np.minimum(right, len(b) - 1)
    return np.where(np.abs(a - b[left]) <= np.abs(b[right] - a), left, right)


def nothing_left(fields: Fields) -> None:
    """Refuse words of the mapping that nobody took: a misspelt one would be ignored."""
    for key in fields.rest:
        expected = f"one of {', '.join(fields.asked)}"
        raise RecordingError(f"{fields.at(key)} is unknown", expected=expected, remedy="correct its spelling")
