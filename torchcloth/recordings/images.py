"""Images of a camera, in folders or inside a file of another format; they are decoded only when needed."""

from __future__ import annotations

import csv
import io
import math
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ..errors import MissingDependency, RecordingError
from . import checks
from .files import Folder, check_fetched, is_present

ImageKind = Literal["depth", "color", "mask"]
IMAGE_KINDS: tuple[ImageKind, ...] = ("depth", "color", "mask")
TIMESTAMPS_FILE = "timestamps.csv"
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_TIMESTAMP_COLUMNS = ["frame", "t_color", "t_depth"]
_SUFFIXES: dict[ImageKind, set[str]] = {"depth": {".png"}, "color": {".jpg", ".jpeg", ".png"}, "mask": {".png"}}


class ImageSource(ABC):
    """Images inside a file of another format, decoded one after the other; it can be iterated repeatedly."""

    @abstractmethod
    def __iter__(self) -> Iterator[np.ndarray | bytes]:
        """Iterate over pixels as ``ImageStream.load`` gives them, or bytes of whole PNG or JPEG files."""

    def file(self, i: int) -> Path | None:
        """Return the file of image ``i`` for messages; None if it has no file of its own."""
        return None


@dataclass(frozen=True, eq=False)
class ImageStream:
    """N images of one kind with their times: files, or a source from which they are decoded when they are written.

    Attributes:
        kind: "depth", "color" or "mask".
        frames: [N] frame numbers, as in the file names.
        t: [N] s.
        paths: one file per image; empty with a source.
        size: (width, height) in pixels.
        source: gives the images if there are no files.
    """

    kind: ImageKind
    frames: np.ndarray
    t: np.ndarray
    paths: tuple[Path, ...]
    size: tuple[int, int]
    source: ImageSource | None = None

    def __len__(self) -> int:
        return len(self.frames)

    def load(self, i: int) -> np.ndarray:
        """Decode image ``i``: depth uint16 [H, W] (0 = invalid), colour uint8 [H, W, 3], mask bool [H, W].

        A source is iterated from its beginning for each call; write the episode first to read many images.

        Raises:
            RecordingError: the file is damaged or does not have the camera's size.
            MissingDependency: Pillow is not installed.
        """
        if self.source is None:
            return self._decode_checked(self.paths[i], str(self.paths[i]))
        for image in islice(self.source, range(len(self))[i], None):
            return self._decode_checked(image, self._place(i, i))
        raise RecordingError(f"{self.kind} image {i} is missing", expected=f"{len(self)} images", remedy="record again")

    def iterate_files(self) -> Iterator[tuple[int, str, bytes]]:
        """Iterate over frame number, suffix and bytes of each image as a file.

        Images of a source are decoded and checked. Pixels are stored as PNG without loss; PNG and JPEG files stay as
        they are.
        """
        frames = self.frames.tolist()
        i = -1
        for i, image in enumerate(self.paths if self.source is None else self.source):
            if i == len(frames):
                raise RecordingError(f"{self.kind} images are too many", expected=f"{len(self)}, one for each time")
            if isinstance(image, Path):
                data = check_fetched(image.read_bytes(), str(image))
                self._decode_checked(data, str(image))  # a damaged image is not passed on
                yield frames[i], image.suffix, data
            else:
                yield frames[i], *self._encode_file(image, self._place(i, frames[i]))
        if i + 1 < len(frames):
            raise RecordingError(f"{self.kind} image {frames[i + 1]} is missing", expected="one for each time")

    def _place(self, i: int, number: int) -> str:
        """Name of image ``i`` in messages."""
        file = None if self.source is None else self.source.file(i)
        return f"{self.kind} image {number}" if file is None else f"{file}: {self.kind} image {number}"

    def _encode_file(self, image: np.ndarray | bytes, place: str) -> tuple[str, bytes]:
        pixels = self._decode_checked(image, place)
        if isinstance(image, bytes):
            suffix = ".png" if image.startswith(PNG_SIGNATURE) else ".jpg"
            if suffix not in _SUFFIXES[self.kind]:
                raise RecordingError(f"{place} is JPEG", expected="PNG", remedy="export without loss")
            return suffix, image
        grey = pixels.astype(np.uint8) * np.uint8(255) if self.kind == "mask" else pixels
        file = io.BytesIO()
        import_pillow().fromarray(grey).save(file, "PNG", compress_level=1)  # 6 takes 4 times as long for a tenth less
        return ".png", file.getvalue()

    def _decode_checked(self, image: Path | bytes | np.ndarray, place: str) -> np.ndarray:
        """Pixels of a file or of its bytes, of the kind's type and the camera's size."""
        pixels = image if isinstance(image, np.ndarray) else _decode(image, place, rgb=self.kind == "color")
        if self.kind == "depth" and pixels.dtype != np.uint16:
            raise RecordingError(
                f"{place} is no depth image", got=pixels.dtype, expected="uint16", remedy="export raw depth"
            )
        if pixels.shape[:2] != self.size[::-1]:
            raise RecordingError(
                f"{place} has the wrong size", got=pixels.shape[1::-1], expected=f"{self.size}, as calibrated"
            )
        return _to_mask(pixels.reshape(*self.size[::-1], -1)) if self.kind == "mask" else pixels


def _to_mask(pixels: np.ndarray) -> np.ndarray:
    """Mask [H, W] of pixels [H, W, C]: neither black nor, if the last channel is alpha, transparent."""
    if pixels.shape[-1] in (2, 4):
        pixels = pixels[..., :-1] * (pixels[..., -1:] > 0)
    return np.any(pixels, axis=-1, keepdims=False)


def import_pillow() -> Any:
    """Import Pillow's module Image.

    Raises:
        MissingDependency: Pillow is not installed.
    """
    try:
        from PIL import Image  # pyright: ignore[reportMissingImports]  (optional)
    except ImportError as error:
        raise MissingDependency("reading images needs Pillow", remedy="pip install pillow") from error
    return Image


def _decode(image: Path | bytes, place: str, *, rgb: bool) -> np.ndarray:
    reader = import_pillow()
    try:
        data = image if isinstance(image, bytes) else check_fetched(image.read_bytes(), place)
        if data.startswith(PNG_SIGNATURE):
            reader.open(io.BytesIO(data)).verify()  # decoding does not verify the checksums
        with reader.open(io.BytesIO(data)) as opened:
            indexed = "RGBA" if opened.mode in ("P", "PA") else None  # use the palette's colours, not its indices
            mode = "RGB" if rgb else indexed
            return np.asarray(opened if mode is None else opened.convert(mode))
    except RecordingError:
        raise
    except Exception as error:  # a damaged image raises whatever its decoder pleases
        raise RecordingError(f"{place} cannot be decoded", got=type(error).__name__, remedy="restore it") from error


def list_image_streams(folder: Folder, size: tuple[int, int]) -> dict[ImageKind, ImageStream]:
    """List the image folders of one camera.

    Masks take the depth image's time, or the colour image's if there is no depth.
    """
    present: list[ImageKind] = [kind for kind in IMAGE_KINDS if folder.has(kind)]
    if not present:
        return {}
    color, depth = _read_times(folder)
    times: dict[ImageKind, dict[int, float]] = {"color": color, "depth": depth, "mask": color | depth}
    streams: dict[ImageKind, ImageStream] = {}
    for kind in present:
        paths = _list(folder, kind)
        if kind == "mask":
            times[kind] = {n: t for n, t in times[kind].items() if n in paths}
        wrong = sorted(paths.keys() ^ times[kind].keys())
        if wrong:
            got = f"frame {wrong[0]} in only one of them"
            raise RecordingError(
                f"{folder.location(kind)} and {TIMESTAMPS_FILE} do not match",
                got=got,
                remedy="give each image one time",
            )
        frames = np.array(sorted(paths), dtype=np.int64)
        t = np.array([times[kind][n] for n in frames.tolist()], dtype=float)
        checks.check_increasing(t, f"{folder.location(TIMESTAMPS_FILE)}: t of {kind}")
        streams[kind] = ImageStream(kind, frames, t, tuple(paths[n] for n in frames.tolist()), size)
    return streams


def format_timestamps(streams: dict[ImageKind, ImageStream]) -> str:
    """Return the text of timestamps.csv; masks without depth images are timed in the depth column."""
    times = {kind: dict(zip(s.frames.tolist(), s.t.tolist(), strict=True)) for kind, s in streams.items()}
    color, depth = times.get("color", {}), times.get("depth", times.get("mask", {}))
    rows = [f"{n},{color.get(n, '')},{depth.get(n, '')}" for n in sorted(color.keys() | depth.keys())]
    return "\n".join([",".join(_TIMESTAMP_COLUMNS), *rows]) + "\n"


def _list(folder: Folder, kind: ImageKind) -> dict[int, Path]:
    place = folder.location(kind)
    try:
        paths = [p for p in (folder.path / kind).iterdir() if p.suffix.lower() in _SUFFIXES[kind]]
    except OSError as error:
        raise RecordingError(f"{place} cannot be listed", got=error.strerror, expected="a folder of images") from error
    for path in paths:
        is_present(path)
    named = [p for p in paths if p.stem.isdecimal()]
    if not paths or len(named) < len(paths) or len({int(p.stem) for p in named}) < len(paths):
        got = "no image" if not paths else "names that are not distinct frame numbers"
        raise RecordingError(
            f"{place} is no image stream", got=got, expected="%06d" + min(_SUFFIXES[kind]), remedy="rename them"
        )
    return {int(p.stem): p for p in named}


def _read_times(folder: Folder) -> tuple[dict[int, float], dict[int, float]]:
    """Times of the colour and depth images by frame number; an empty cell means no image."""
    place = folder.location(TIMESTAMPS_FILE)
    color: dict[int, float] = {}
    depth: dict[int, float] = {}
    try:
        header, *rows = csv.reader(folder.read_text(TIMESTAMPS_FILE).splitlines())
        if [cell.strip() for cell in header] != _TIMESTAMP_COLUMNS:
            raise ValueError(f"header {header}")
        if len({int(row[0]) for row in rows}) < len(rows):
            raise ValueError("a frame listed twice")
        for frame, t_color, t_depth in rows:
            color |= {int(frame): float(t_color)} if t_color.strip() else {}
            depth |= {int(frame): float(t_depth)} if t_depth.strip() else {}
        if not all(map(math.isfinite, [*color.values(), *depth.values()])):
            raise ValueError("a time that is not finite")
    except RecordingError:
        raise
    except (ValueError, IndexError, csv.Error) as error:
        raise RecordingError(
            f"{place} is damaged", got=error, expected=f"rows of {','.join(_TIMESTAMP_COLUMNS)}"
        ) from error
    return color, depth
