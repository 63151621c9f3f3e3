"""Azure Kinect recordings: the Matroska files of k4arecorder, read by PyAV without Microsoft's retired SDK.

Depth is a raw 16-bit track in millimetres (fourcc b16g), colour is usually Motion JPEG, and the factory calibration is
an attachment. Depth and colour come from two lenses, so they become two cameras, "depth" and "color" (other names with
``"source": {"depth": NAME, "color": NAME}``). The depth image is strongly distorted. Its rational coefficients stay
with the camera, and it must never be used as a pinhole image. The scene gives T_world_camera of the depth camera; that
of the colour camera follows from the calibration.

The files carry no checksum. Changed bytes inside raw depth or JPEG pixels and a shifted time are not detected; lost
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
from ..images import ImageKind, ImageSource, ImageStream
from . import matroska
from .imported import Imported, ImportedCamera, Importer, pair_frames, reject_unknown_keys, report_damage, to_seconds
from .scene_file import SceneFile
from .video import VideoFrames, open_video, read_packet_times, reject_logged_errors

KINECT_NAME = "kinect"
KINECT_TITLE = "Azure Kinect MKV"
KINECT_DEPTH_SCALE_M = 0.001
KINECT_CALIBRATION_FILE = "calibration.json"
TRACK_TITLES: dict[ImageKind, str] = {"depth": "DEPTH", "color": "COLOR"}
IGNORED_TRACK_TITLES = ("IR", "IMU")
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
SENSOR_MODES = {"depth": DEPTH_MODES, "color": COLOR_MODES}
LENS_LOCATIONS: dict[ImageKind, str] = {
    "depth": "CALIBRATION_CameraLocationD0",
    "color": "CALIBRATION_CameraLocationPV0",
}
LENS_PARAMETER_COUNT = 14  # cx cy fx fy k1 k2 k3 k4 k5 k6 codx cody p2 p1, relative to the sensor's size
KINECT_UNCHECKED = "pixels, times and calibration"
MATROSKA_TIME_TOLERANCE_NS = 1_000_000  # Matroska may store integer milliseconds
MAX_MISSING_LAST_FRAMES = 10  # frames by which a lens may stop before the file ends


def matches(path: Path) -> bool:
    """Return whether a path is a Matroska file, by its content."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(4) == matroska.MATROSKA_SIGNATURE


def read(path: Path, scene: SceneFile, episode: int | None) -> Imported:
    """Read the tracks and the calibration; images are decoded when they are written.

    Args:
        path: the .mkv file.
        scene: the scene file.
        episode: unused; a file holds one episode.

    Raises:
        RecordingError: the file is damaged, truncated or not by k4arecorder.
    """
    source = scene.source
    names = {kind: source.optional(source.text, kind) or kind for kind in TRACK_TITLES}
    reject_unknown_keys(source)
    if len(set(names.values())) < len(names):
        raise RecordingError(f"{source.place} gives both lenses one name", got=names["depth"], expected="two names")
    tracks, calibration = _tracks(path)
    packet_times = read_packet_times(path)
    if sorted(len(t) for t in packet_times.values()) != sorted(matroska.count_blocks(path).values()):
        remedy = "copy it again"
        raise RecordingError(f"{path} is damaged", got="blocks that FFmpeg cannot find", remedy=remedy)
    times = {kind: packet_times.get(track["index"], np.zeros(0, dtype=np.int64)) for kind, track in tracks.items()}
    for kind, track in tracks.items():
        _check_complete(path, times[kind], kind, track["end"])
    numbers = {kind: np.arange(len(t)) for kind, t in times.items()}
    if "color" in times:
        numbers["color"], numbers["depth"] = pair_frames(times["color"], times["depth"])
    imported = Imported(
        notes={"format": KINECT_NAME, "serial": tracks["depth"]["serial"], "unchecked": KINECT_UNCHECKED}
    )
    for kind, track in tracks.items():
        size = track["size"]
        known: dict[str, Any] = {"width": size[0], "height": size[1]}
        if kind == "depth":
            known["depth_scale"] = KINECT_DEPTH_SCALE_M
        if calibration is not None:
            known |= lens_intrinsics(_lens(calibration, kind, path), kind, size, str(path))
        frames = _frames(path, kind, track, times[kind])
        stream = ImageStream(kind, numbers[kind], to_seconds(times[kind], 0), (), size, frames)
        placed_by = names["depth"] if kind == "color" and calibration is not None else None
        imported.cameras[names[kind]] = ImportedCamera(known, {kind: stream}, placed_by)
    given_pose = scene.camera_entry(names["depth"]).get("T_world_camera")
    if given_pose is not None and calibration is not None and "color" in tracks:
        pose = checks.check_array(given_pose, f"{scene.name}: cameras.{names['depth']}.T_world_camera", (4, 4))
        turn = depth_to_color_pose(calibration, path)
        imported.cameras[names["color"]].calibration["T_world_camera"] = pose @ np.linalg.inv(turn)
    return imported


def _tracks(path: Path) -> tuple[dict[ImageKind, dict[str, Any]], dict[str, Any] | None]:
    """Index, size and codec of the depth and colour tracks, and the attached calibration."""
    tracks: dict[ImageKind, dict[str, Any]] = {}
    calibration = None
    with open_video(path) as container, reject_logged_errors(path), report_damage(path, "Matroska file"):
        if "matroska" not in container.format.name:
            raise RecordingError(f"{path} is no Matroska file", got=container.format.name, expected="an .mkv")
        end = None if container.duration is None else int(container.duration) * 1000
        serial = container.metadata.get("K4A_DEVICE_SERIAL_NUMBER", "")
        for stream in container.streams:
            if stream.type == "attachment" and stream.name == KINECT_CALIBRATION_FILE:
                calibration = json.loads(bytes(stream.data))
            title = stream.metadata.get("title")
            kind: ImageKind | None = next((k for k, t in TRACK_TITLES.items() if title == t), None)
            if stream.type != "attachment" and title not in (*TRACK_TITLES.values(), *IGNORED_TRACK_TITLES):
                expected = ", ".join((*TRACK_TITLES.values(), *IGNORED_TRACK_TITLES))
                raise RecordingError(f"{path}: a track has an unknown title", got=repr(title), expected=expected)
            if kind is None:
                continue
            if stream.type != "video":
                raise RecordingError(f"{path}: track {title} is no video", got=stream.type)
            if kind in tracks:
                raise RecordingError(f"{path} has two {TRACK_TITLES[kind]} tracks", expected="one")
            context = stream.codec_context
            size = (int(context.width), int(context.height))
            tracks[kind] = {"index": stream.index, "size": size, "codec": context.name, "end": end, "serial": serial}
    if "depth" not in tracks:
        expected = "a track with the title DEPTH, as k4arecorder writes it"
        raise RecordingError(f"{path} is no Azure Kinect recording", got="no depth track", expected=expected)
    if calibration is not None and not isinstance(calibration, dict):
        raise RecordingError(f"{path}: {KINECT_CALIBRATION_FILE} is damaged", got=type(calibration).__name__)
    return tracks, calibration


def _check_complete(path: Path, times: np.ndarray, kind: ImageKind, end: int | None) -> None:
    """Refuse a file that ends before the end that its header gives."""
    if not len(times):
        raise RecordingError(f"{path} has no {kind} image", expected="a recording of some frames")
    if end is None or len(times) < 2:
        return
    frame = int(np.median(np.diff(times)))
    if times[-1] + MAX_MISSING_LAST_FRAMES * frame + MATROSKA_TIME_TOLERANCE_NS < end:
        got, expected = f"the last {kind} image at {times[-1] / 1e9:.3f} s", f"images until {end / 1e9:.3f} s"
        raise RecordingError(f"{path} is truncated", got=got, expected=expected, remedy="copy it again")


def _frames(path: Path, kind: ImageKind, track: dict[str, Any], times: np.ndarray) -> ImageSource:
    if track["codec"] == "mjpeg":
        return _JpegTrack(path, track["index"])
    return VideoFrames(path, track["index"], kind, times, MATROSKA_TIME_TOLERANCE_NS)


class _JpegTrack(ImageSource):
    """The packets of a Motion JPEG track, each a JPEG file, unchanged."""

    def __init__(self, path: Path, track: int) -> None:
        self.path, self.track = path, track

    def __iter__(self) -> Iterator[bytes]:
        with open_video(self.path) as container, reject_logged_errors(self.path):
            packets = container.demux(container.streams[self.track])
            while True:
                with report_damage(self.path, "Matroska file"):
                    packet = next(packets, None)
                    if packet is None:
                        return
                if packet.size:
                    yield bytes(packet)


def _lens(calibration: dict[str, Any], kind: ImageKind, path: Path) -> dict[str, Any]:
    """Calibration of one lens."""
    with report_damage(f"{path}: {KINECT_CALIBRATION_FILE}", "calibration"):
        cameras = calibration["CalibrationInformation"]["Cameras"]
        return next(camera for camera in cameras if camera["Location"] == LENS_LOCATIONS[kind])


def lens_intrinsics(lens: dict[str, Any], kind: ImageKind, size: tuple[int, int], place: str) -> dict[str, Any]:
    """Return K [3, 3] px and the eight rational coefficients (OpenCV order) of a lens at an image size.

    The factory's numbers count from the corner of the first pixel; OpenCV counts from its centre.

    Raises:
        RecordingError: another model, an unknown size, or a principal point outside the image.
    """
    place = f"{place}: {KINECT_CALIBRATION_FILE}, {LENS_LOCATIONS[kind]}"
    fields = Fields(Fields(lens, place).take("Intrinsics"), place)
    values = fields.array("ModelParameters", "N")
    if len(values) < LENS_PARAMETER_COUNT or "BrownConrady" not in fields.text("ModelType"):
        raise RecordingError(
            f"{place} has another model", got=fields.remaining.get("ModelType"), expected="Brown-Conrady"
        )
    if size not in SENSOR_MODES[kind]:
        expected = f"one of {sorted(SENSOR_MODES[kind])}"
        raise RecordingError(f"{place} does not know this size", got=size, expected=expected)
    sensor, crop = SENSOR_MODES[kind][size]
    cx, cy, fx, fy, k1, k2, k3, k4, k5, k6, codx, cody, p2, p1 = values[:LENS_PARAMETER_COUNT]
    if codx or cody:
        raise RecordingError(f"{place} has a centre of distortion", got=[codx, cody], expected="[0, 0]")
    high, wide = (Fields(lens, place).whole_number(key) for key in ("SensorHeight", "SensorWidth"))
    if kind == "color" and 9 * wide == 16 * high:  # an older calibration is relative to a 16:9 image
        cy, fy = (cy * 2304 + 384) / 3072, fy * 2304 / 3072
    K = np.eye(3)
    K[0, 0], K[1, 1] = fx * sensor[0], fy * sensor[1]
    K[0, 2], K[1, 2] = cx * sensor[0] - crop[0] - 0.5, cy * sensor[1] - crop[1] - 0.5
    if not (0 < K[0, 2] < size[0] and 0 < K[1, 2] < size[1] and min(K[0, 0], K[1, 1]) > 0):
        raise RecordingError(f"{place} looks away from the image", got=K.tolist())
    return {"K": K, "distortion": np.array([k1, k2, p1, p2, k3, k4, k5, k6])}


def depth_to_color_pose(calibration: dict[str, Any], path: Path) -> np.ndarray:
    """Return the pose [4, 4] that takes points of the depth lens to the colour lens, both OpenCV."""
    matrices = {}
    for kind in TRACK_TITLES:
        place = f"{path}: {KINECT_CALIBRATION_FILE}, {LENS_LOCATIONS[kind]}"
        fields = Fields(Fields(_lens(calibration, kind, path), place).take("Rt"), place)
        matrix = np.eye(4)
        matrix[:3, :3] = fields.array("Rotation", 9).reshape(3, 3)
        matrix[:3, 3] = fields.array("Translation", 3)
        matrices[kind] = checks.check_transform(matrix, place)
    return matrices["color"] @ np.linalg.inv(matrices["depth"])


KINECT_IMPORTER = Importer(KINECT_NAME, KINECT_TITLE, matches, read)
