"""Recordings of other formats: imported into a `Recording`, and written as MCAP.

    recording = formats.read("session.mcap", scene="scene.json")
    recordings.write(recording, "episodes/ep_01")

Each importer is a module with NAME, TITLE, ``matches(path)`` (by content) and ``read(path, scene, episode)``. What only
the user knows stands in a side file in the words of episode.json; see `side`. Images are decoded when they are written.
"""

from __future__ import annotations

from pathlib import Path

from ...errors import InvalidInput, RecordingError
from .. import reading
from ..types import Recording
from . import kinect, lerobot, redwood, ros2, tum
from .mcap_writer import write as write_mcap
from .sidecar import Scene

IMPORTERS = (ros2, lerobot, redwood, tum, kinect)
EPISODE = "episode"
NAMES = (EPISODE, *(importer.NAME for importer in IMPORTERS))
KNOWN = {  # files that people take for one of ours
    b"PAR1": "a parquet file",
    b"\x89PNG": "a PNG image",
    b"\xff\xd8\xff": "a JPEG image",
    b"PK\x03\x04": "a ZIP or NPZ archive",
    b"#ROSBAG V": "a ROS 1 bag",
    b"\x89HDF": "an HDF5 file",
}

__all__ = ["NAMES", "Scene", "detect", "read", "write_mcap"]


def detect(path: str | Path) -> str:
    """The name of the format, by content.

    Raises:
        RecordingError: nothing is there, or it is of no known format.
    """
    path = Path(path)
    try:
        if not path.exists():
            raise RecordingError(f"{path} does not exist", expected="a recording", remedy="check the path")
        if path.is_dir() and (path / reading.EPISODE).is_file():
            return EPISODE
        found = next((i.NAME for i in IMPORTERS if i.matches(path)), None)
    except RecordingError:
        raise
    except (OSError, ValueError) as error:
        raise RecordingError(f"{path} cannot be read", got=error, expected="a recording") from error
    if found is None:
        expected = ", ".join(importer.TITLE for importer in IMPORTERS) + ", or an episode folder"
        raise RecordingError(f"{path} is of no known format", got=_content(path), expected=expected)
    return found


def read(
    path: str | Path, *, format: str | None = None, scene: str | Path | None = None, episode: int | None = None
) -> Recording:
    """Read a recording of any known format.

    Args:
        path: file or folder.
        format: what it must be, one of ``NAMES``; None finds out.
        scene: JSON file with what the recording does not tell, in the words of episode.json.
        episode: which one, where a file holds many.

    Raises:
        RecordingError: it cannot be trusted, is of another format, or the scene lacks or contradicts something.
        InvalidInput: the format is unknown.
    """
    path = Path(path)
    if format is not None and format not in NAMES:
        raise InvalidInput("format is unknown", got=repr(format), expected=f"one of {', '.join(NAMES)}")
    found = detect(path)
    if format is not None and format != found:
        raise RecordingError(f"{path} is mislabelled", got=f"content of {found}", expected=format)
    if episode is not None and found != lerobot.NAME:
        raise RecordingError(f"{path} holds one episode", got=f"--episode {episode}", remedy="leave it out")
    if found == EPISODE:
        if scene is not None:
            raise RecordingError(f"{path} is an episode", got="a scene", remedy="edit its episode.json instead")
        return reading.read(path, with_truth=True)
    side = Scene.read(None if scene is None else Path(scene))
    importer = next(importer for importer in IMPORTERS if found == importer.NAME)
    return side.complete(importer.read(path, side, episode), path)


def _content(path: Path) -> str:
    if path.is_dir():
        names = sorted(p.name for p in path.iterdir())[:6]
        return f"a folder with {', '.join(names) or 'nothing'}"
    with path.open("rb") as file:
        head = file.read(12)
    if head[4:8] == b"ftyp":
        return "an MP4 video"
    return next((what for magic, what in KNOWN.items() if head.startswith(magic)), repr(head[:8]))
