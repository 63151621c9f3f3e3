"""Frames of a video track by PyAV, each checked against its expected time.

Detected are: packets and frames that the decoder flags, errors that FFmpeg only logs, checksums if the codec has them
(FFV1 with slicecrc), and frames that are missing, too many or at another time. Changed bytes that decode to another
picture are not detected in codecs without checksums (raw video, JPEG, H.264, AV1).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import MissingDependency, RecordingError
from ..images import ImageKind, ImageSource
from .imported import report_damage

STRICT_DECODER_OPTIONS = {"err_detect": "crccheck+bitstream+buffer+explode"}
# No playlists, which name other files and addresses; FFmpeg tells a container by its content, not by its name.
CONTAINER_OPTIONS = {"format_whitelist": "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm", "protocol_whitelist": "file"}
MIN_SEEK_TIME_NS = 2 * 10**9  # before this, decoding from the start is as fast
PIXEL_FORMATS = {"depth": "gray16le", "color": "rgb24", "mask": "gray"}


class VideoFrames(ImageSource):
    """The frames of one track at given times.

    Args:
        path: the video file.
        track: number of the stream in it.
        kind: what they show; depth must be 16-bit grey.
        times: [N] ns, from the start of the file.
        tolerance: ns, by which a frame's time may differ.
    """

    def __init__(self, path: Path, track: int, kind: ImageKind, times: np.ndarray, tolerance: int) -> None:
        self.path, self.track, self.kind = path, track, kind
        self.times, self.tolerance = times, tolerance

    def __iter__(self) -> Iterator[np.ndarray]:
        with open_video(self.path) as container, reject_logged_errors(self.path):
            with report_damage(self.path, "video"):
                stream = container.streams[self.track]
                stream.codec_context.options = STRICT_DECODER_OPTIONS
                if self.times[0] > MIN_SEEK_TIME_NS:
                    container.seek(int(self.times[0] - MIN_SEEK_TIME_NS // 2) // 1000)
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
        """Time [ns] and frame, for all frames that decode without an error."""
        packets = container.demux(stream)
        while True:
            with report_damage(self.path, "video"):
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
        with report_damage(self.path, "video"):
            return frame.to_ndarray(format=PIXEL_FORMATS[self.kind])


@contextmanager
def open_video(path: Path) -> Iterator[Any]:
    """Open the container of a video file.

    Raises:
        MissingDependency: PyAV is not installed.
        RecordingError: the file cannot be opened.
    """
    try:
        import av  # pyright: ignore[reportMissingImports]  (optional)
    except ImportError as error:
        raise MissingDependency("reading video needs PyAV", remedy='pip install "torchcloth[data]"') from error
    with report_damage(path, "video"):
        container = av.open(str(path), container_options=CONTAINER_OPTIONS)
    try:
        yield container
    finally:
        container.close()


@contextmanager
def reject_logged_errors(path: Path) -> Iterator[None]:
    """Refuse the file if FFmpeg logs an error inside: it would continue past damage and skip frames."""
    import av.logging  # pyright: ignore[reportMissingImports]

    before = av.logging.get_level()
    av.logging.set_level(av.logging.ERROR)
    try:
        with av.logging.Capture(local=False) as log:  # decoders have their own threads
            yield
            errors = [text.strip() for level, _, text in log if level <= av.logging.ERROR]
    finally:
        av.logging.set_level(before)
    if errors:
        raise RecordingError(f"{path} is damaged", got=errors[0][:120], remedy="copy or record it again")


def read_packet_times(path: Path) -> dict[int, np.ndarray]:
    """Read the times [N] ns of the packets of each track in the order of the file, from its start, without decoding."""
    times: dict[int, list[int]] = {}
    with open_video(path) as container, reject_logged_errors(path), report_damage(path, "video"):
        for packet in container.demux():
            if packet.size:
                if packet.pts is None or packet.is_corrupt:
                    raise RecordingError(f"{path} is damaged", got="a packet without a time", remedy="copy it again")
                ns = int(packet.pts * packet.time_base * 10**9)
                times.setdefault(packet.stream_index, []).append(ns)
        return {track: np.array(values, dtype=np.int64) for track, values in times.items()}
