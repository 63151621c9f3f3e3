"""Importers of other formats, and the MCAP writer.

    recording = formats.read("session.mcap", scene="scene.json")
    recordings.write(recording, "episodes/ep_01")

============================  ==========================================
ROS bags                      ``ros2`` (folders, .mcap, .db3 and .bag files)
LeRobot v3                    ``lerobot``
Azure Kinect .mkv             ``kinect``
Open3D/Redwood RGB-D folders  ``redwood``
TUM RGB-D folders             ``tum``
Folders of .pcd clouds        ``pcd``
Captures of RGBench           ``rgbench``
============================  ==========================================

Each importer is a module that defines an ``Importer``. What only
the user knows is in a scene file with the keys of episode.json; see ``scene_file``. Images are decoded when they are
written.
"""

from __future__ import annotations

from pathlib import Path

from ...errors import InvalidInput, RecordingError
from .. import reading
from ..files import is_present
from ..types import Recording
from .kinect import KINECT_IMPORTER
from .lerobot import LEROBOT_IMPORTER, LEROBOT_NAME
from .mcap_writer import write as write_mcap
from .pcd import PCD_IMPORTER
from .redwood import REDWOOD_IMPORTER
from .rgbench import RGBENCH_IMPORTER
from .ros2 import ROS2_IMPORTER
from .scene_file import SceneFile
from .tum import TUM_IMPORTER

IMPORTERS = (
    ROS2_IMPORTER,
    LEROBOT_IMPORTER,
    REDWOOD_IMPORTER,
    TUM_IMPORTER,
    KINECT_IMPORTER,
    RGBENCH_IMPORTER,
    PCD_IMPORTER,
)
EPISODE_FOLDER_FORMAT = "episode"
FORMAT_NAMES = (EPISODE_FOLDER_FORMAT, *(importer.name for importer in IMPORTERS))
CLOUD_SUFFIXES = {".ply", ".xyz", ".las", ".npy"}
BUILD_IN_PYTHON_PAGE = "docs/how-to/import-recordings.md, Add the motion in Python"
FOREIGN_SIGNATURES = {  # of files that are often confused with a recording
    b"PAR1": "a parquet file",
    b"\x89PNG": "a PNG image",
    b"\xff\xd8\xff": "a JPEG image",
    b"PK\x03\x04": "a ZIP or NPZ archive",
    b"#ROSBAG V": "a ROS 1 bag",
    b"\x89HDF": "an HDF5 file",
    b"# .PCD": "a point cloud (PCD)",
    b"ply": "a point cloud or mesh (PLY)",
}

__all__ = ["FORMAT_NAMES", "SceneFile", "detect_format", "read", "write_mcap"]


def detect_format(path: str | Path) -> str:
    """Return the name of the format, by content.

    Raises:
        RecordingError: nothing is there, or it is of no known format.
    """
    path = Path(path)
    try:
        if not is_present(path):
            raise RecordingError(f"{path} does not exist", expected="a recording", remedy="check the path")
        if path.is_dir() and is_present(path / reading.EPISODE_FILE):
            return EPISODE_FOLDER_FORMAT
        name = next((i.name for i in IMPORTERS if i.matches(path)), None)
        remedy = "" if name else _remedy(path)
    except RecordingError:
        raise
    except (OSError, ValueError) as error:
        raise RecordingError(f"{path} cannot be read", got=error, expected="a recording") from error
    if name is None:
        expected = ", ".join(importer.title for importer in IMPORTERS) + ", or an episode folder"
        raise RecordingError(f"{path} is of no known format", got=_content(path), expected=expected, remedy=remedy)
    return name


def read(
    path: str | Path, *, format: str | None = None, scene: str | Path | None = None, episode: int | None = None
) -> Recording:
    """Read a recording of any known format.

    Args:
        path: file or folder.
        format: what it must be, one of ``FORMAT_NAMES``; None detects it.
        scene: JSON file with what the recording does not contain, in the keys of episode.json.
        episode: which one, if a file holds many.

    Raises:
        RecordingError: it cannot be trusted, is of another format, or the scene lacks or contradicts something.
        InvalidInput: the format is unknown.
    """
    path = Path(path)
    if format is not None and format not in FORMAT_NAMES:
        raise InvalidInput("format is unknown", got=repr(format), expected=f"one of {', '.join(FORMAT_NAMES)}")
    detected = detect_format(path)
    if format is not None and format != detected:
        raise RecordingError(f"{path} is mislabelled", got=f"content of {detected}", expected=format)
    if episode is not None and detected != LEROBOT_NAME:
        raise RecordingError(f"{path} holds one episode", got=f"--episode {episode}", remedy="leave it out")
    if detected == EPISODE_FOLDER_FORMAT:
        if scene is not None:
            raise RecordingError(f"{path} is an episode", got="a scene", remedy="edit its episode.json instead")
        return reading.read(path, with_truth=True)
    scene_file = SceneFile.read(None if scene is None else Path(scene))
    importer = next(importer for importer in IMPORTERS if detected == importer.name)
    return scene_file.complete_recording(importer.read(path, scene_file, episode), path)


def _remedy(path: Path) -> str:
    """Return what to do about a path that no importer reads."""
    missing = next((text for importer in IMPORTERS if (text := importer.describe_missing(path))), "")
    if missing:
        return f"{missing}; or build the episode in Python ({BUILD_IN_PYTHON_PAGE})"
    names = [p.suffix.lower() for p in path.iterdir()] if path.is_dir() else [path.suffix.lower()]
    if not CLOUD_SUFFIXES.isdisjoint(names):
        return f"files of point clouds are not read: build PointClouds in Python ({BUILD_IN_PYTHON_PAGE})"
    if path.is_file() and path.suffix.lower() == ".parquet":
        return "pass the folder of the LeRobot data set, which holds meta/info.json"
    return ""


def _content(path: Path) -> str:
    if path.is_dir():
        names = sorted(p.name for p in path.iterdir())[:6]
        return f"a folder with {', '.join(names) or 'nothing'}"
    with path.open("rb") as file:
        head = file.read(12)
    if head[4:8] == b"ftyp":
        return "an MP4 video"
    return next((what for magic, what in FOREIGN_SIGNATURES.items() if head.startswith(magic)), repr(head[:8]))
