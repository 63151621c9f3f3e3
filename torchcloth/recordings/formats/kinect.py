"""Azure Kinect recordings: the Matroska files of k4arecorder, read by PyAV without Microsoft's retired SDK.

Depth is a raw 16-bit track in millimetres (fourcc b16g), colour usually Motion JPEG, the factory calibration an
attachment. Depth and colour come from two lenses: they become two cameras, "depth" and "color" (other names with
``"source": {"depth": NAME, "color": NAME}``). The depth image is strongly distorted: its rational coefficients stay
with the camera, and it must never be taken for a pinhole image. The scene gives T_world_camera of the depth camera;
that of the colour camera follows from the calibration.

Not noticed: changed bytes inside raw depth or JPEG pixels and a shifted time, for the files carry no checksum; lost
frames at the end and damaged structure are. Order of the calibration's numbers and crops of the sensor: Azure Kinect
Sensor SDK (MIT), src/transformation/mode_specific_calibration.c.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import RecordingError
from .. import checks
from ..checks import Fields
from ..images import ImageSource, ImageStream, Kind
from . import matroska
from .imported import Imported, ImportedCamera, damaged, frame_numbers, nothing_left, seconds
from .sidecar import Scene
from .video import VideoFrames, listening, opened, packet_times

NAME = "kinect"
TITLE = "Azure Kinect MKV"
MILLIMETRE = 0.001
CALIBRATION = "calibration.json"
TRACKS: dict[Kind, str] = {"depth": "DEPTH", "color": "COLOR"}
OTHERS = ("IR", "IMU")  # of no use here
# size: (binned sensor, crop) in pixels
DEPTH_MODES = {
    (640, 576): ((1024, 1024), (192, 180)),
    (320, 288): ((512, 512), (96, 90)),
    (512, 512): ((512, 512), (0, 0)),
    (1024, 1024): ((1024, 1024), (0, 0)),
}
COLOR_MODES = {
    (1280, 720): ((1280, 960), (0, 120)),
    (1920, 1080): ((1920, 1440), (0, 180)),
    (2560, 1440): ((2560, 1920), (0, 240)),
    (2048, 1536): ((2048, 1536), (0, 0)),
    (3840, 2160): ((3840, 2880), (0, 360)),
    (4096, 3072): ((4096, 3072), (0, 0)),
}
MODES = {"depth": DEPTH_MODES, "color": COLOR_MODES}
LENSES: dict[Kind, str] = {"depth": "CALIBRATION_CameraLocationD0", "color": "CALIBRATION_CameraLocationPV0"}
PARAMETERS = 14  # cx cy fx fy k1 k2 k3 k4 k5 k6 codx cody p2 p1, in parts of the sensor's size
UNCHECKED = "pixels, times and calibration"
TOLERANCE = 1_000_000  # ns; Matroska may store whole milliseconds
SLACK = 10  # frames by which a lens may stop before the file ends


def matches(path: Path) -> bool:
    """Whether it is a Matroska file, by its content."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(4) == matroska.MAGIC


def read(path: Path, scene: Scene, episode: int | None) -> Imported:
    """Read the tracks and the calibration; images are decoded when they are written."""
    source = scene.source
    names = {kind: source.maybe(source.text, kind) or kind for kind in TRACKS}
    nothing_left(source)
    if len(set(names.values())) < len(names):
        raise RecordingError(f"{source.place} gives both lenses one name", got=names["depth"], expected="two names")
    tracks, calibration = _tracks(path)
    every = packet_times(path)
    if sorted(len(t) for t in every.values()) != sorted(matroska.blocks(path).values()):
        remedy = "copy it again"
        raise RecordingError(f"{path} is damaged", got="blocks that FFmpeg cannot find", remedy=remedy)
    times = {kind: every.get(track["index"], np.zeros(0, dtype=np.int64)) for kind, track in tracks.items()}
    for kind, track in tracks.items():
        _complete(path, times[kind], kind, track["end"])
    numbers = {kind: np.arange(len(t)) for kind, t in times.items()}
    if "color" in times:
        numbers["color"], numbers["depth"] = frame_numbers(times["color"], times["depth"])
    found = Imported(notes={"format": NAME, "serial": tracks["depth"]["serial"], "unchecked": UNCHECKED})
    for kind, track in tracks.items():
        size = track["size"]
        known: dict[str, Any] = {"width": size[0], "height": size[1]}
        if kind == "depth":
            known["depth_scale"] = MILLIMETRE
        if calibration is not None:
            known |= intrinsics(_lens(calibration, kind, path), kind, size, str(path))
        frames = _frames(path, kind, track, times[kind])
        stream = ImageStream(kind, numbers[kind], seconds(times[kind], 0), (), size, frames)
        placed_by = names["depth"] if kind == "color" and calibration is not None else None
        found.cameras[names[kind]] = ImportedCamera(known, {kind: stream}, placed_by)
    said = scene.camera(names["depth"]).get("T_world_camera")
    if said is not None and calibration is not None and "color" in tracks:
        pose = checks.array(said, f"{scene.name}: cameras.{names['depth']}.T_world_camera", (4, 4))
        turn = depth_to_color(calibration, path)
        found.cameras[names["color"]].known["T_world_camera"] = pose @ np.linalg.inv(turn)
    return found


def _tracks(path: Path) -> tuple[dict[Kind, dict[str, Any]], dict[str, Any] | None]:
    """Index, size and codec of the depth and colour tracks, and the attached calibration."""
    found: dict[Kind, dict[str, Any]] = {}
    calibration = None
    with opened(path) as container, listening(path), damaged(path, "Matroska file"):
        if "matroska" not in container.format.name:
            raise RecordingError(f"{path} is no Matroska file", got=container.format.name, expected="an .mkv")
        end = None if container.duration is None else int(container.duration) * 1000
        serial = container.metadata.get("K4A_DEVICE_SERIAL_NUMBER", "")
        for stream in container.streams:
            if stream.type == "attachment" and stream.name == CALIBRATION:
                calibration = json.loads(bytes(stream.data))
            title = stream.metadata.get("title")
            kind: Kind | None = next((k for k, t in TRACKS.items() if title == t), None)
            if stream.type != "attachment" and title not in (*TRACKS.values(), *OTHERS):
                expected = ", ".join((*TRACKS.values(), *OTHERS))
                raise RecordingError(f"{path}: a track has an unknown title", got=repr(title), expected=expected)
            if kind is None:
                continue
            if stream.type != "video":
                raise RecordingError(f"{path}: track {title} is no video", got=stream.type)
            if kind in found:
                raise RecordingError(f"{path} has two {TRACKS[kind]} tracks", expected="one")
            context = stream.codec_context
            size = (int(context.width), int(context.height))
            found[kind] = {"index": stream.index, "size": size, "codec": context.name, "end": end, "serial": serial}
    if "depth" not in found:
        expected = "a track with the title DEPTH, as k4arecorder writes it"
        raise RecordingError(f"{path} is no Azure Kinect recording", got="no depth track", expected=expected)
    if calibration is not None and not isinstance(calibration, dict):
        raise RecordingError(f"{path}: {CALIBRATION} is damaged", got=type(calibration).__name__)
    return found, calibration


def _complete(path: Path, times: np.ndarray, kind: Kind, end: int | None) -> None:
    """Refuse a file that ends before the end which its head names."""
    if not len(times):
        raise RecordingError(f"{path} has no {kind} image", expected="a recording of some frames")
    if end is None or len(times) < 2:
        return
    frame = int(np.median(np.diff(times)))
    if times[-1] + SLACK * frame + TOLERANCE < end:
        got, expected = f"the last {kind} image at {times[-1] / 1e9:.3f} s", f"images until {end / 1e9:.3f} s"
        raise RecordingError(f"{path} is truncated", got=got, expected=expected, remedy="copy it again")


def _frames(path: Path, kind: Kind, track: dict[str, Any], times: np.ndarray) -> ImageSource:
    if track["codec"] == "mjpeg":
        return _JpegTrack(path, track["index"])
    return VideoFrames(path, track["index"], kind, times, TOLERANCE)


class _JpegTrack(ImageSource):
    """The packets of a Motion JPEG track, each a JPEG file, as they are."""

    def __init__(self, path: Path, track: int) -> None:
        self.path, self.track = path, track

    def __iter__(self) -> Iterator[bytes]:
        with opened(self.path) as container, listening(self.path):
            packets = container.demux(container.streams[self.track])
            while True:
                with damaged(self.path, "Matroska file"):
                    packet = next(packets, None)
                    if packet is None:
                        return
                if packet.size:
                    yield bytes(packet)


def _lens(calibration: dict[str, Any], kind: Kind, path: Path) -> dict[str, Any]:
    """What the calibration says of one lens."""
    with damaged(f"{path}: {CALIBRATION}", "calibration"):
        cameras = calibration["CalibrationInformation"]["Cameras"]
        return next(camera for camera in cameras if camera["Location"] == LENSES[kind])


def intrinsics(lens: dict[str, Any], kind: Kind, size: tuple[int, int], place: str) -> dict[str, Any]:
    """K [3, 3] px and the eight rational coefficients (OpenCV order) of a lens at an image size.

    The factory's numbers count from the corner of the first pixel; OpenCV counts from its centre.
    """
    place = f"{place}: {CALIBRATION}, {LENSES[kind]}"
    fields = Fields(Fields(lens, place).take("Intrinsics"), place)
    values = fields.array("ModelParameters", "N")
    if len(values) < PARAMETERS or "BrownConrady" not in fields.text("ModelType"):
        raise RecordingError(f"{place} has another model", got=fields.rest.get("ModelType"), expected="Brown-Conrady")
    if size not in MODES[kind]:
        expected = f"one of {sorted(MODES[kind])}"
        raise RecordingError(f"{place} does not know this size", got=size, expected=expected)
    sensor, crop = MODES[kind][size]
    cx, cy, fx, fy, k1, k2, k3, k4, k5, k6, codx, cody, p2, p1 = values[:PARAMETERS]
    if codx or cody:
        raise RecordingError(f"{place} has a centre of distortion", got=[codx, cody], expected="[0, 0]")
    high, wide = (Fields(lens, place).whole(key) for key in ("SensorHeight", "SensorWidth"))
    if kind == "color" and 9 * wide == 16 * high:  # an older calibration counts in parts of 16:9
        cy, fy = (cy * 2304 + 384) / 3072, fy * 2304 / 3072
    K = np.eye(3)
    K[0, 0], K[1, 1] = fx * sensor[0], fy * sensor[1]
    K[0, 2], K[1, 2] = cx * sensor[0] - crop[0] - 0.5, cy * sensor[1] - crop[1] - 0.5
    if not (0 < K[0, 2] < size[0] and 0 < K[1, 2] < size[1] and min(K[0, 0], K[1, 1]) > 0):
        raise RecordingError(f"{place} looks away from the image", got=K.tolist())
    return {"K": K, "distortion": np.array([k1, k2, p1, p2, k3, k4, k5, k6])}


def depth_to_color(calibration: dict[str, Any], path: Path) -> np.ndarray:
    """The pose [4, 4] that takes points of the depth lens to the colour lens, both OpenCV."""
    matrices = {}
    for kind in TRACKS:
        place = f"{path}: {CALIBRATION}, {LENSES[kind]}"
        fields = Fields(Fields(_lens(calibration, kind, path), place).take("Rt"), place)
        matrix = np.eye(4)
        matrix[:3, :3] = fields.array("Rotation", 9).reshape(3, 3)
        matrix[:3, 3] = fields.array("Translation", 3)
        matrices[kind] = checks.transform(matrix, place)
    return matrices["color"] @ np.linalg.inv(matrices["depth"])
