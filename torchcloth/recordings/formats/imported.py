"""The result of an importer, and helpers that importers share."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ...errors import MissingDependency, RecordingError, TorchclothError
from .. import checks
from ..checks import Fields
from ..files import check_fetched, is_present
from ..images import ImageKind, ImageSource, ImageStream, import_pillow

MAX_SHOWN_CHARACTERS = 60  # of a value in a message
NANOSECONDS_PER_SECOND = 10**9
MIN_MEDIAN_DEPTH_M, MAX_MEDIAN_DEPTH_M = 0.05, 30.0
MIN_DESK_DEPTH_M, MAX_DESK_DEPTH_M = 0.3, 5.0  # median depth of a scene on a desk or before a robot
MILLIMETRE_DEPTH_SCALE_M = 0.001  # per unit, the most frequent unit of depth images
MAX_PAIRING_DELAY_NS = 20_000_000  # between two images of one frame, as in TUM's associate.py


@dataclass
class ImportedCamera:
    """One camera of the file.

    Attributes:
        calibration: what the file contains, in the keys of episode.json.
        streams: its images by kind.
        placed_by: another camera, whose pose in the scene also places this one.
    """

    calibration: dict[str, Any] = field(default_factory=dict)
    streams: dict[ImageKind, ImageStream] = field(default_factory=dict)
    placed_by: str | None = None


@dataclass
class Imported:
    """The content of a file of another format; the scene file adds the rest.

    Attributes:
        motion: by name, as the groups of motion.npz.
        points: as in points.npz.
        cameras: by name.
        streams: further streams, by the names of ``Recording``.
        notes: origin of the data; stored as "source" in the episode.
    """

    motion: dict[str, dict[str, np.ndarray]] = field(default_factory=dict)
    points: dict[str, np.ndarray] | None = None
    cameras: dict[str, ImportedCamera] = field(default_factory=dict)
    streams: dict[str, Any] = field(default_factory=dict)
    notes: dict[str, Any] = field(default_factory=dict)


class Importer(NamedTuple):
    """An importer of one format.

    Attributes:
        name: of the format.
        title: of the format, for people.
        matches: whether a path is of this format, by its content.
        read: reads (path, scene file, number of the episode or None).
        describe_missing: what a path of this format lacks to be read; "" if it resembles another format or none.
    """

    name: str
    title: str
    matches: Callable[[Path], bool]
    read: Callable[[Path, Any, int | None], Imported]
    describe_missing: Callable[[Path], str] = lambda path: ""


class FileImages(ImageSource):
    """Image files of another layout, which are read and checked when they are copied into the episode."""

    def __init__(self, paths: Sequence[Path]) -> None:
        self.paths = tuple(paths)

    def __iter__(self) -> Iterator[bytes]:
        for path in self.paths:
            yield read_bytes(path)

    def file(self, i: int) -> Path:
        """Return the file of image ``i``."""
        return self.paths[i]


def read_bytes(path: Path) -> bytes:
    """Return the bytes of a file that must exist."""
    is_present(path)
    try:
        return check_fetched(path.read_bytes(), str(path))
    except (OSError, ValueError) as error:  # ValueError: a name that no file system can hold
        reason = getattr(error, "strerror", None) or error
        raise RecordingError(f"{path} cannot be read", got=reason, expected="a readable file") from error


def read_text(path: Path) -> str:
    """Return the text of a UTF-8 file, without a byte order mark."""
    try:
        return read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise RecordingError(f"{path} is not UTF-8 text", got=error.reason, remedy="restore it") from error


@contextmanager
def report_damage(path: Path | str, what: str, *, remedy: str = "record or copy it again") -> Iterator[None]:
    """Turn any error of a library about a damaged file into one ``RecordingError``."""
    try:
        yield
    except (TorchclothError, MissingDependency):
        raise
    except Exception as error:  # decoders raise anything: struct, key, assertion, memory, their own
        got = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise RecordingError(f"{path} is no sound {what}", got=got, remedy=remedy) from error


def image_size(path: Path | bytes) -> tuple[int, int]:
    """Return (width, height) from the header of a PNG or JPEG file."""
    place = path if isinstance(path, Path) else "an image"
    data = path if isinstance(path, bytes) else read_bytes(path)
    with report_damage(place, "image"), import_pillow().open(io.BytesIO(data)) as image:
        return image.size


def check_depth_scale(depth: ImageStream, scale: float, path: Path, *, is_assumed: bool) -> None:
    """Refuse depths that lie beyond any cloth experiment in the unit that is taken.

    Args:
        depth: the images, of which the first is decoded.
        scale: m per unit.
        path: the first image, for messages.
        is_assumed: whether nobody stated the unit. Then depths nearer than a desk are refused if they would be as far
            as a desk in millimetres.

    Raises:
        RecordingError: the median depth cannot be in this unit.
    """
    depth_image = depth.load(0)
    units = float(np.median(depth_image[depth_image > 0])) if (depth_image > 0).any() else 1.0 / scale
    middle, in_millimetres = units * scale, units * MILLIMETRE_DEPTH_SCALE_M
    if is_assumed and middle < MIN_DESK_DEPTH_M <= in_millimetres <= MAX_DESK_DEPTH_M:
        got = f"a median depth of {middle:.3g} m, which would be {in_millimetres:.3g} m in millimetres"
        remedy = (
            f"set cameras.NAME.depth_scale in the scene: {MILLIMETRE_DEPTH_SCALE_M:g} for millimetres, or {scale:g} if "
            "the camera is that near"
        )
        what = f"{path}: unit of depth is unclear"
        raise RecordingError(what, got=got, expected=f"units of {scale:g} m", remedy=remedy)
    if not MIN_MEDIAN_DEPTH_M < middle < MAX_MEDIAN_DEPTH_M:
        got, remedy = f"a median depth of {middle:.3g} m", "set cameras.NAME.depth_scale in the scene"
        raise RecordingError(f"{path} is not in units of {scale:g} m", got=got, expected="0.05 to 30 m", remedy=remedy)


def order_by_stamp(stamps: Sequence[int], contents: Sequence[bytes], place: str) -> tuple[np.ndarray, list[str]]:
    """Return which messages to use, in the order of their stamps, each once.

    Args:
        stamps: [N] ns, as recorded.
        contents: the content of each message, or a digest of it.
        place: where the messages are from, for the notes.

    Returns:
        Indices of the messages to use, and notes on what was changed. Two messages of one stamp with different contents
        both stay: the check of the times refuses them.
    """
    order = sorted(range(len(stamps)), key=lambda i: stamps[i])
    seen: dict[int, set[bytes]] = {}
    chosen = []
    for i in order:
        known = seen.setdefault(stamps[i], set())
        if contents[i] not in known:
            chosen.append(i)
        known.add(contents[i])
    notes = []
    if len(chosen) < len(stamps):
        notes.append(f"{place}: {len(stamps) - len(chosen)} of {len(stamps)} messages were there twice, one is used")
    times = np.array(stamps, dtype=np.int64)
    late = int((times < np.maximum.accumulate(times)).sum()) if len(times) else 0
    if late:
        notes.append(f"{place}: {late} of {len(stamps)} messages were out of order, sorted by header.stamp")
    return np.array(chosen, dtype=np.int64), notes


def to_seconds(nanoseconds: Sequence[int] | np.ndarray, start: int) -> np.ndarray:
    """Return times [N] s since ``start``, each the float64 nearest to its integer nanoseconds."""
    return (np.asarray(nanoseconds, dtype=np.int64) - start) / NANOSECONDS_PER_SECOND


def parse_nanoseconds(text: str, place: str) -> int:
    """Parse integer nanoseconds from a decimal number of seconds, without going through a float."""
    from decimal import Decimal, InvalidOperation

    try:
        value = Decimal(text) * NANOSECONDS_PER_SECOND
        if value.is_finite() and abs(value) > checks.MAX_EPOCH_S * NANOSECONDS_PER_SECOND:
            checks.check_increasing(np.array([float(text)]), place)
        if not value.is_finite() or abs(value) > 2**62:
            raise InvalidOperation
        return int(value)
    except ArithmeticError as error:  # it overflows, too
        raise RecordingError(
            f"{place} is no time", got=repr(text[:MAX_SHOWN_CHARACTERS]), expected="seconds"
        ) from error


def require_fixed_pose(
    poses: np.ndarray, place: str, *, metres: float = 2e-3, radians: float = 4e-3, remedy: str = ""
) -> np.ndarray:
    """Return the one pose [4, 4] of a camera that stood still for all of ``poses`` [N, 4, 4].

    Raises:
        RecordingError: the camera moves.
    """
    poses = np.stack([checks.check_transform(pose, place) for pose in poses])
    first = poses[0]
    moved = np.linalg.norm(poses[:, :3, 3] - first[:3, 3], axis=1).max()
    traces = np.einsum("ij,nij->n", first[:3, :3], poses[:, :3, :3])
    turned = math.acos(float(np.clip((traces.min() - 1) / 2, -1, 1)))
    if moved > metres or turned > radians:
        got = f"{moved:.3g} m and {math.degrees(turned):.3g} degrees"
        expected = "a camera that stands still, an episode holds one pose for it"
        raise RecordingError(f"{place} moves", got=got, expected=expected, remedy=remedy)
    return first


def to_pose_matrices(position: np.ndarray, quat_wxyz: np.ndarray, place: str) -> np.ndarray:
    """Return poses [N, 4, 4] from positions [N, 3] m and unit quaternions [N, 4]."""
    checks.normalise_unit(quat_wxyz, place)
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


def to_quaternions(matrices: np.ndarray) -> np.ndarray:
    """Return unit quaternions [N, 4], scalar first, of rotations [N, 3, 3].

    The method is that of Bar-Itzhack (2000), which is valid at half turns too.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = np.moveaxis(matrices, 0, -1)
    rows = [
        [xx + yy + zz, zy - yz, xz - zx, yx - xy],
        [zy - yz, xx - yy - zz, xy + yx, xz + zx],
        [xz - zx, xy + yx, yy - xx - zz, yz + zy],
        [yx - xy, xz + zx, yz + zy, zz - xx - yy],
    ]
    quat = np.linalg.eigh(np.moveaxis(np.array(rows), -1, 0))[1][..., -1]
    return quat * np.where(quat[:, :1] < 0, -1.0, 1.0)


def pair_frames(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return frame numbers of two streams by their times [ns]: two images that are each other's nearest share one."""
    to_b, to_a = _nearest(a, b), _nearest(b, a)
    paired = {
        i: int(j) for i, j in enumerate(to_b) if to_a[j] == i and abs(int(a[i]) - int(b[j])) <= MAX_PAIRING_DELAY_NS
    }
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


def reject_unknown_keys(fields: Fields) -> None:
    """Refuse keys of the mapping that were not taken: a typo would be ignored."""
    for key in fields.remaining:
        expected = f"one of {', '.join(fields.requested)}"
        raise RecordingError(f"{fields.location(key)} is unknown", expected=expected, remedy="correct its spelling")
