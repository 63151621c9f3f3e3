"""The TUM RGB-D layout: ``rgb.txt``, ``depth.txt``, ``groundtruth.txt``.

    rgb.txt, depth.txt    timestamp filename
    groundtruth.txt       timestamp tx ty tz qx qy qz qw    (camera to world; scalar last)

Lines with ``#`` are comments. Depth is in 1/5000 m, unless the scene says otherwise. Colour and depth have clocks
ticks of their own; a colour and a depth image that are each other's nearest within 20 ms share a frame number, every
other image keeps one of its own. The layout holds no intrinsics: the scene gives them. ``"source": {"trajectory":
"left", "closed": true}`` reads groundtruth.txt as the path of the gripper "left" instead, for those who track the hand.

Text carries no checksum: a changed digit that stays plausible goes unnoticed, and so do changed bytes in the pixels
of a JPEG; PNG files are verified.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...errors import RecordingError
from .. import checks
from ..images import ImageStream, Kind
from .imported import (
    LONGEST_NAME,
    FileImages,
    Imported,
    ImportedCamera,
    file_text,
    fixed_pose,
    frame_numbers,
    image_size,
    nanoseconds,
    nothing_left,
    plausible,
    pose_matrix,
    seconds,
)
from .sidecar import Scene

NAME = "tum"
TITLE = "TUM RGB-D folder"
CAMERA = "cam0"
UNCHECKED = "times, poses, and pixels of JPEG images"
DEPTH_SCALE = 1 / 5000  # m per unit, as the layout has it
LISTS: dict[Kind, str] = {"color": "rgb.txt", "depth": "depth.txt"}
TRUTH = "groundtruth.txt"


def matches(path: Path) -> bool:
    """Whether the folder is laid out like this."""
    return all((path / file).is_file() for file in LISTS.values())


def read(path: Path, scene: Scene, episode: int | None) -> Imported:
    """Read the folder; the images are checked when they are copied."""
    source = scene.source
    name = source.maybe(source.text, "camera") or CAMERA
    hand = source.maybe(source.text, "trajectory")
    closed = source.maybe(source.take, "closed") if hand is not None else None
    nothing_left(source)
    lists: dict[Kind, list[tuple[int, Path]]] = {kind: _list(path, file) for kind, file in LISTS.items()}
    stamps: dict[Kind, np.ndarray] = {
        kind: np.array([ns for ns, _ in rows], dtype=np.int64) for kind, rows in lists.items()
    }
    truth = _truth(path / TRUTH) if (path / TRUTH).is_file() else None
    start = int(min(t[0] for t in stamps.values()))
    numbers: dict[Kind, np.ndarray] = {}
    numbers["color"], numbers["depth"] = frame_numbers(stamps["color"], stamps["depth"])
    size = image_size(lists["depth"][0][1])
    scale = scene.depth_scale(name) or DEPTH_SCALE
    camera = ImportedCamera({"width": size[0], "height": size[1], "depth_scale": scale})
    for kind, rows in lists.items():
        source_of = FileImages([file for _, file in rows])
        camera.streams[kind] = ImageStream(kind, numbers[kind], seconds(stamps[kind], start), (), size, source_of)
    plausible(camera.streams["depth"], scale, lists["depth"][0][1])
    found = Imported(cameras={name: camera}, notes={"format": NAME, "start_ns": start, "unchecked": UNCHECKED})
    if truth is not None and hand is None:
        remedy = f'if {TRUTH} tracks a gripper, write "source": {{"trajectory": "left", "closed": true}}'
        poses = pose_matrix(truth[1], truth[2], str(path / TRUTH))
        camera.known["T_world_camera"] = fixed_pose(poses, str(path / TRUTH), remedy=remedy)
    elif truth is not None and hand is not None:
        if not isinstance(closed, bool):
            raise RecordingError(f"{source.at('closed')} is unclear", got=closed, expected="true or false")
        t = seconds(truth[0], start)
        found.motion[hand] = {"t": t, "position": truth[1], "quat_wxyz": truth[2], "closed": np.full(len(t), closed)}
    elif hand is not None:
        raise RecordingError(f"{path / TRUTH} is missing", expected=f"the path of {hand!r}")
    return found


def _rows(file: Path, columns: int) -> list[list[str]]:
    rows = [line.split() for line in file_text(file).splitlines() if line.strip() and not line.lstrip().startswith("#")]
    wrong = next((row for row in rows if len(row) != columns), None)
    if not rows or wrong:
        got = "no line" if not rows else repr(" ".join(wrong or [])[:LONGEST_NAME])
        raise RecordingError(f"{file} is damaged", got=got, expected=f"lines of {columns} words")
    return rows


def _stamps(rows: list[list[str]], file: Path) -> np.ndarray:
    stamps = np.array([nanoseconds(row[0], str(file)) for row in rows], dtype=np.int64)
    checks.increasing(seconds(stamps, int(stamps[0])), str(file))
    return stamps


def _list(folder: Path, name: str) -> list[tuple[int, Path]]:
    """Time and path of each image; a path may not leave the folder, and no image may stand twice."""
    rows = _rows(folder / name, 2)
    files = [row[1] for row in rows]
    strange = next((f for f in files if Path(f).is_absolute() or ".." in Path(f).parts or "\0" in f), None)
    if strange is not None or len(set(files)) < len(files):
        got = strange or "a file listed twice"
        raise RecordingError(f"{folder / name} names wrong files", got=repr(got), expected="images below the folder")
    parents = {((folder / f).parent, Path(f).suffix) for f in files}
    beside = {p for parent, suffix in parents for p in parent.glob("*") if p.suffix == suffix}
    forgotten = sorted(beside - {folder / f for f in files})
    if forgotten:
        got, expected = f"{forgotten[0].name} not listed", "every image; the list may have been cut"
        raise RecordingError(f"{folder / name} is incomplete", got=got, expected=expected, remedy="list or remove it")
    return list(zip(_stamps(rows, folder / name).tolist(), (folder / f for f in files), strict=True))


def _truth(file: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times [N] ns, positions [N, 3] m, quaternions [N, 4] scalar first."""
    rows = _rows(file, 8)
    try:
        values = np.array([[float(word) for word in row[1:]] for row in rows])
    except ValueError as error:
        raise RecordingError(f"{file} is damaged", got=error, expected="numbers") from error
    values = checks.array(values, str(file), ("N", 7))
    checks.metres(values[:, :3], str(file))
    quat = values[:, [6, 3, 4, 5]]
    checks.unit(quat, str(file))
    return _stamps(rows, file), values[:, :3], quat
