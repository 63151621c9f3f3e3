"""What the topics of a ROS 2 bag say of one camera: intrinsics, and images that are decoded when written."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from ...errors import RecordingError
from ..checks import Fields
from ..images import KINDS, ImageSource, ImageStream, Kind
from . import ros2_messages
from .bag import Bag, Message
from .imported import ImportedCamera, frame_numbers, image_size, nothing_left, seconds
from .ros2_topics import topic

MILLIMETRE = 0.001  # of 16UC1, by REP 118
FINE = 0.0002  # m per unit for depth in metres (32FC1): 0.1 mm of rounding, up to 13 m
FARTHEST = np.iinfo(np.uint16).max


class CameraTopics:
    """The topics of one camera."""

    def __init__(self, fields: Fields, bag: Bag, depth_scale: float | None) -> None:
        self.place, self.bag, self.depth_scale = fields.place, bag, depth_scale
        self.images: dict[Kind, str] = {
            kind: topic(fields, kind, bag, "Image", "CompressedImage") for kind in KINDS if fields.has(kind)
        }
        self.info = topic(fields, "info", bag, "CameraInfo") if fields.has("info") else None
        numbers = fields.inside("frames")
        self.numbers: dict[Kind, np.ndarray] = {
            kind: numbers.array(kind, "N", kind="int") for kind in KINDS if numbers.has(kind)
        }
        rectified = fields.maybe(fields.take, "rectified")
        if not isinstance(rectified, bool | None):
            raise RecordingError(f"{fields.at('rectified')} is unclear", got=rectified, expected="true or false")
        if rectified is None and self.info and any("rect" in name for name in self.images.values()):
            raise RecordingError(f"{fields.at('rectified')} is missing", expected="true if the images are rectified")
        self.rectified = bool(rectified)
        nothing_left(fields)
        self.topics = [*self.images.values(), *([self.info] if self.info else [])]
        self._stamps: dict[Kind, list[int]] = {kind: [] for kind in self.images}
        self._sizes: dict[Kind, tuple[int, int]] = {}
        self._metres = False
        self._known: dict[str, Any] | None = None

    def take(self, message: Message) -> None:
        """Keep the time of an image, or the calibration."""
        if message.topic == self.info:
            self._calibrate(message)
        for kind, name in self.images.items():
            if name == message.topic:
                self._stamps[kind].append(ros2_messages.stamp(message.body, message.place))
                if kind not in self._sizes:
                    self._sizes[kind] = _size(message)
                    self._metres |= kind == "depth" and getattr(message.body, "encoding", "") == "32FC1"

    def stamps(self) -> list[int]:
        """Times of measurement [ns]."""
        return [stamp for stamps in self._stamps.values() for stamp in stamps]

    def camera(self, start: int) -> ImportedCamera:
        """The camera with its images."""
        empty = [self.images[kind] for kind, stamps in self._stamps.items() if not stamps]
        if empty or (self.info and self._known is None):
            raise RecordingError(f"{self.place}: {empty[0] if empty else self.info} is empty", expected="messages")
        known = dict(self._known or {})
        if self._sizes and not self.info:
            known["width"], known["height"] = next(iter(self._sizes.values()))
        if "depth" in self.images:
            known["depth_scale"] = FINE if self._metres else self.depth_scale or MILLIMETRE
        numbers = self._frames()
        streams: dict[Kind, ImageStream] = {
            kind: ImageStream(
                kind,
                numbers[kind],
                seconds(stamps, start),
                (),
                self._sizes[kind],
                BagImages(self.bag, self.images[kind], kind),
            )
            for kind, stamps in self._stamps.items()
        }
        return ImportedCamera(known, streams)

    def _calibrate(self, message: Message) -> None:
        known = ros2_messages.intrinsics(message.body, message.place, rectified=self.rectified)
        if self._known is not None and any(not np.array_equal(known[k], self._known[k]) for k in known):
            raise RecordingError(f"{message.place} changes the calibration", expected="one for the whole episode")
        self._known = known

    def _frames(self) -> dict[Kind, np.ndarray]:
        """Frame numbers: a colour and a depth image taken together share one, a mask has its image's."""
        stamps: dict[Kind, np.ndarray] = {kind: np.array(value, dtype=np.int64) for kind, value in self._stamps.items()}
        if self.numbers:
            wrong = [k for k, s in stamps.items() if len(self.numbers.get(k, ())) != len(s)]
            if wrong:
                raise RecordingError(f"{self.place}.frames.{wrong[0]} does not fit", expected="one for each image")
            return dict(self.numbers)
        numbers: dict[Kind, np.ndarray] = {kind: np.arange(len(s)) for kind, s in stamps.items()}
        if "color" in stamps and "depth" in stamps:
            numbers["color"], numbers["depth"] = frame_numbers(stamps["color"], stamps["depth"])
        of: Kind | None = next((kind for kind in KINDS if kind in stamps and kind != "mask"), None)
        if "mask" in stamps and of:
            by_time = dict(zip(stamps[of].tolist(), numbers[of].tolist(), strict=True))
            lost = [s for s in stamps["mask"].tolist() if s not in by_time]
            if lost:
                expected = f"the time stamp of a {of} image"
                raise RecordingError(f"{self.images['mask']} masks nothing", got=f"{lost[0]} ns", expected=expected)
            numbers["mask"] = np.array([by_time[s] for s in stamps["mask"].tolist()])
        return numbers


class BagImages(ImageSource):
    """The images of one topic, decoded one after the other."""

    def __init__(self, bag: Bag, name: str, kind: Kind) -> None:
        self.bag, self.topic, self.kind = bag, name, kind

    def __iter__(self) -> Iterator[np.ndarray | bytes]:
        for message in self.bag.messages([self.topic]):
            if hasattr(message.body, "encoding"):
                yield self._pixels(message)
            else:
                yield ros2_messages.compressed(message.body, message.place)

    def _pixels(self, message: Message) -> np.ndarray:
        pixels = ros2_messages.pixels(message.body, message.place)
        if (message.body.encoding in ros2_messages.DEPTHS) != (self.kind == "depth"):
            raise RecordingError(f"{message.place} is no {self.kind} image", got=message.body.encoding)
        if pixels.dtype.kind == "f":
            units = np.round(np.where(np.isfinite(pixels), pixels, 0.0) / FINE)
            if units.min() < 0:
                got = f"{units.min() * FINE:g} m"
                raise RecordingError(f"{message.place} is out of range", got=got, expected="depth >= 0")
            return np.where(units <= FARTHEST, units, 0).astype(np.uint16)  # what lies beyond is invalid
        if self.kind == "color" and pixels.ndim == 2:
            return np.repeat(pixels[..., None], 3, axis=2)
        return np.ascontiguousarray(pixels)


def _size(message: Message) -> tuple[int, int]:
    if hasattr(message.body, "encoding"):
        return int(message.body.width), int(message.body.height)
    return image_size(ros2_messages.compressed(message.body, message.place))
