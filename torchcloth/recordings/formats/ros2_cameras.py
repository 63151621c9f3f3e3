"""Topics of one camera in a ROS 2 bag: intrinsics, and images that are decoded when they are written."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from typing import Any

import numpy as np

from ...errors import RecordingError
from ..checks import Fields
from ..images import IMAGE_KINDS, ImageKind, ImageSource, ImageStream
from . import ros2_messages
from .bag import Bag, BagMessage
from .imported import ImportedCamera, image_size, order_by_stamp, pair_frames, reject_unknown_keys, to_seconds
from .ros2_topics import require_topic

REP118_DEPTH_SCALE_M = 0.001  # per unit of 16UC1, by REP 118
FLOAT_DEPTH_SCALE_M = 0.0002  # per unit for depth in metres (32FC1): 0.1 mm of rounding, up to 13 m
MAX_DEPTH_UNITS = np.iinfo(np.uint16).max


class CameraTopics:
    """The topics of one camera."""

    def __init__(self, fields: Fields, bag: Bag, depth_scale: float | None) -> None:
        self.place, self.bag, self.depth_scale = fields.place, bag, depth_scale
        self.images: dict[ImageKind, str] = {
            kind: require_topic(fields, kind, bag, "Image", "CompressedImage")
            for kind in IMAGE_KINDS
            if fields.has(kind)
        }
        self.info = require_topic(fields, "info", bag, "CameraInfo") if fields.has("info") else None
        numbers = fields.group("frames")
        self.numbers: dict[ImageKind, np.ndarray] = {
            kind: numbers.array(kind, "N", kind="int") for kind in IMAGE_KINDS if numbers.has(kind)
        }
        rectified = fields.optional(fields.take, "rectified")
        if not isinstance(rectified, bool | None):
            raise RecordingError(f"{fields.location('rectified')} is unclear", got=rectified, expected="true or false")
        if rectified is None and self.info and any("rect" in name for name in self.images.values()):
            raise RecordingError(
                f"{fields.location('rectified')} is missing", expected="true if the images are rectified"
            )
        self.rectified = bool(rectified)
        reject_unknown_keys(fields)
        self.topics = [*self.images.values(), *([self.info] if self.info else [])]
        self._stamps: dict[ImageKind, list[int]] = {kind: [] for kind in self.images}
        self._digests: dict[ImageKind, list[bytes]] = {kind: [] for kind in self.images}
        self._sizes: dict[ImageKind, tuple[int, int]] = {}
        self.notes: list[str] = []
        self._metres = False
        self._known: dict[str, Any] | None = None

    def take(self, message: BagMessage) -> None:
        """Store the time of an image, or the calibration."""
        if message.topic == self.info:
            self._calibrate(message)
        for kind, name in self.images.items():
            if name == message.topic:
                self._stamps[kind].append(ros2_messages.read_stamp(message.body, message.place))
                self._digests[kind].append(hashlib.blake2b(message.body.data, digest_size=16).digest())
                if kind not in self._sizes:
                    self._sizes[kind] = _size(message)
                    self._metres |= kind == "depth" and getattr(message.body, "encoding", "") == "32FC1"

    def stamps(self) -> list[int]:
        """Return the times of measurement [ns]."""
        return [stamp for stamps in self._stamps.values() for stamp in stamps]

    def camera(self, start: int) -> ImportedCamera:
        """Return the camera with its images."""
        empty = [self.images[kind] for kind, stamps in self._stamps.items() if not stamps]
        if empty or (self.info and self._known is None):
            raise RecordingError(f"{self.place}: {empty[0] if empty else self.info} is empty", expected="messages")
        known = dict(self._known or {})
        if self._sizes and not self.info:
            known["width"], known["height"] = next(iter(self._sizes.values()))
        if "depth" in self.images:
            known["depth_scale"] = FLOAT_DEPTH_SCALE_M if self._metres else self.depth_scale or REP118_DEPTH_SCALE_M
        chosen: dict[ImageKind, np.ndarray] = {}
        for kind, stamps in self._stamps.items():
            chosen[kind], notes = order_by_stamp(stamps, self._digests[kind], self.images[kind])
            self.notes += notes
            self._stamps[kind] = [stamps[i] for i in chosen[kind]]
        numbers = self._frames()
        streams: dict[ImageKind, ImageStream] = {
            kind: ImageStream(
                kind,
                numbers[kind],
                to_seconds(stamps, start),
                (),
                self._sizes[kind],
                BagImages(self.bag, self.images[kind], kind, chosen[kind]),
            )
            for kind, stamps in self._stamps.items()
        }
        return ImportedCamera(known, streams)

    def _calibrate(self, message: BagMessage) -> None:
        known = ros2_messages.read_intrinsics(message.body, message.place, rectified=self.rectified)
        if self._known is not None and any(not np.array_equal(known[k], self._known[k]) for k in known):
            raise RecordingError(f"{message.place} changes the calibration", expected="one for the whole episode")
        self._known = known

    def _frames(self) -> dict[ImageKind, np.ndarray]:
        """Frame numbers: a colour and a depth image of one frame share one, a mask has that of its image."""
        stamps: dict[ImageKind, np.ndarray] = {
            kind: np.array(value, dtype=np.int64) for kind, value in self._stamps.items()
        }
        if self.numbers:
            wrong = [k for k, s in stamps.items() if len(self.numbers.get(k, ())) != len(s)]
            if wrong:
                raise RecordingError(f"{self.place}.frames.{wrong[0]} does not fit", expected="one for each image")
            return dict(self.numbers)
        numbers: dict[ImageKind, np.ndarray] = {kind: np.arange(len(s)) for kind, s in stamps.items()}
        if "color" in stamps and "depth" in stamps:
            numbers["color"], numbers["depth"] = pair_frames(stamps["color"], stamps["depth"])
        image_kind: ImageKind | None = next((kind for kind in IMAGE_KINDS if kind in stamps and kind != "mask"), None)
        if "mask" in stamps and image_kind:
            by_time = dict(zip(stamps[image_kind].tolist(), numbers[image_kind].tolist(), strict=True))
            unmatched = [s for s in stamps["mask"].tolist() if s not in by_time]
            if unmatched:
                expected = f"the time stamp of a {image_kind} image"
                raise RecordingError(
                    f"{self.images['mask']} masks nothing", got=f"{unmatched[0]} ns", expected=expected
                )
            numbers["mask"] = np.array([by_time[s] for s in stamps["mask"].tolist()])
        return numbers


class BagImages(ImageSource):
    """The images of one topic, decoded one after the other.

    Args:
        bag: where they are.
        name: the topic.
        kind: of the images.
        chosen: which messages of the topic to use, in this order; None: all.
    """

    def __init__(self, bag: Bag, name: str, kind: ImageKind, chosen: np.ndarray | None = None) -> None:
        self.bag, self.topic, self.kind = bag, name, kind
        self._ranks = None if chosen is None else {int(i): rank for rank, i in enumerate(chosen)}

    def __iter__(self) -> Iterator[np.ndarray | bytes]:
        early: dict[int, BagMessage] = {}  # messages that were logged before their turn
        rank = 0
        for i, message in enumerate(self.bag.messages([self.topic])):
            if self._ranks is not None and i not in self._ranks:
                continue
            early[i if self._ranks is None else self._ranks[i]] = message
            while rank in early:
                yield self._decode(early.pop(rank))
                rank += 1

    def _decode(self, message: BagMessage) -> np.ndarray | bytes:
        if hasattr(message.body, "encoding"):
            return self._pixels(message)
        return ros2_messages.read_compressed(message.body, message.place)

    def _pixels(self, message: BagMessage) -> np.ndarray:
        pixels = ros2_messages.read_pixels(message.body, message.place)
        if (message.body.encoding in ros2_messages.DEPTH_ENCODINGS) != (self.kind == "depth"):
            raise RecordingError(f"{message.place} is no {self.kind} image", got=message.body.encoding)
        if pixels.dtype.kind == "f":
            units = np.round(np.where(np.isfinite(pixels), pixels, 0.0) / FLOAT_DEPTH_SCALE_M)
            if units.min() < 0:
                got = f"{units.min() * FLOAT_DEPTH_SCALE_M:g} m"
                raise RecordingError(f"{message.place} is out of range", got=got, expected="depth >= 0")
            return np.where(units <= MAX_DEPTH_UNITS, units, 0).astype(np.uint16)  # larger depths are invalid
        if self.kind == "color" and pixels.ndim == 2:
            return np.repeat(pixels[..., None], 3, axis=2)
        return np.ascontiguousarray(pixels)


def _size(message: BagMessage) -> tuple[int, int]:
    if hasattr(message.body, "encoding"):
        return int(message.body.width), int(message.body.height)
    return image_size(ros2_messages.read_compressed(message.body, message.place))
