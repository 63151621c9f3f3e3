"""Frames of a video track by PyAV, each held against the time it must have.

What can be noticed: packets and frames that the decoder flags, errors that FFmpeg only logs, checksums where the
codec has them (FFV1 with slicecrc), frames that are missing, too many or at another time. What cannot: changed bytes
that decode to another picture, in codecs without checksums (raw video, JPEG, H.264, AV1).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import MissingDependency, RecordingError
from ..images import ImageSource, Kind
from .imported import damaged

STRICT = {"err_detect": "crccheck+bitstream+buffer+explode"}
SEEK = 2 * 10**9  # ns; before this, decoding from the start is as quick
FORMATS = {"depth": "gray16le", "color": "rgb24", "mask": "gray"}


class VideoFrames(ImageSource):
    """The frames of one track whose times are these.

    Args:
        path: the video file.
        track: number of the stream in it.
        kind: what they show; depth must be 16-bit grey.
        times: [N] ns from the start of the file.
        tolerance: by which a frame's time may differ [ns].
    """

    def __init__(self, path: Path, track: int, kind: Kind, times: np.ndarray, tolerance: int) -> None:
        self.path, self.track, self.kind = path, track, kind
        self.times, self.tolerance = times, tolerance

    def __iter__(self) -> Iterator[np.ndarray]:
        with opened(self.path) as container, listening(self.path):
            with damaged(self.path, "video"):
                stream = container.streams[self.track]
                stream.codec_context.options = STRICT
                if self.times[0] > SEEK:
                    container.seek(int(self.times[0] - SEEK // 2) // 1000)
            i = 0
            for ns, frame in self._frames(container, stream):
                if ns < self.times[0] - self.tolerance:
                    continue
                if abs(ns - self.times[i]) > self.tolerance:
                    got, expected = f"a frame at {ns / 1e9:.4f} s", f"one at {self.times[i] / 1e9:.4f} s"
                    raise RecordingError(f"{self.path} has lost frames", got=got, expected=expected)
                yield self._pixels(frame)
                i += 1
                if i == len(self.times):
                    return
            got, expected = f"{i} frames", f"{len(self.times)}"
            raise RecordingError(f"{self.path} ends early", got=got, expected=expected, remedy="copy it again")

    def _frames(self, container: Any, stream: Any) -> Iterator[tuple[int, Any]]:
        """Time [ns] and frame, of all that decode without complaint."""
        packets = container.demux(stream)
        while True:
            with damaged(self.path, "video"):
                packet = next(packets, None)
                if packet is None:
                    return
                frames = [] if packet.is_corrupt else packet.decode()
            if packet.is_corrupt or any(frame.is_corrupt for frame in frames):
                raise RecordingError(f"{self.path} is damaged", got="a corrupt frame", remedy="copy it again")
            for frame in frames:
                if frame.pts is None:
                    raise RecordingError(f"{self.path} has a frame without a time", remedy="remux it")
                yield int(frame.pts * frame.time_base * 10**9), frame

    def _pixels(self, frame: Any) -> np.ndarray:
        if (self.kind == "depth") != frame.format.name.startswith("gray16"):
            expected = "16-bit grey" if self.kind == "depth" else "colour"
            raise RecordingError(f"{self.path} holds other pixels", got=frame.format.name, expected=expected)
        with damaged(self.path, "video"):
            return frame.to_ndarray(format=FORMATS[self.kind])


@contextmanager
def opened(path: Path) -> Iterator[Any]:
    """The container of a video file."""
    try:
        import av  # pyright: ignore[reportMissingImports]  (optional)
    except ImportError as error:
        raise MissingDependency("reading video needs PyAV", remedy='pip install "torchcloth[data]"') from error
    with damaged(path, "video"):
        container = av.open(str(path))
    try:
        yield container
    finally:
        container.close()


@contextmanager
def listening(path: Path) -> Iterator[None]:
    """Refuse the file when FFmpeg logs an error inside: it would go on past damage and leave frames out."""
    import av.logging  # pyright: ignore[reportMissingImports]

    before = av.logging.get_level()
    av.logging.set_level(av.logging.ERROR)
    try:
        with av.logging.Capture(local=False) as heard:  # decoders have threads of their own
            yield
            said = [text.strip() for level, _, text in heard if level <= av.logging.ERROR]
    finally:
        av.logging.set_level(before)
    if said:
        raise RecordingError(f"{path} is damaged", got=said[0][:120], remedy="copy or record it again")


def packet_times(path: Path) -> dict[int, np.ndarray]:
    """Times [N] ns of the packets of each track in the order of the file, from its start, without decoding them."""
    times: dict[int, list[int]] = {}
    with opened(path) as container, listening(path), damaged(path, "video"):
        for packet in container.demux():
            if packet.size:
                if packet.pts is None or packet.is_corrupt:
                    raise RecordingError(f"{path} is damaged", got="a packet without a time", remedy="copy it again")
                ns = int(packet.pts * packet.time_base * 10**9)
                times.setdefault(packet.stream_index, []).append(ns)
        return {track: np.array(values, dtype=np.int64) for track, values in times.items()}
