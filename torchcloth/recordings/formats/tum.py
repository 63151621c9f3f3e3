"""The TUM RGB-D layout: ``rgb.txt``, ``depth.txt``, ``groundtruth.txt``.

    rgb.txt, depth.txt    timestamp filename
    groundtruth.txt       timestamp tx ty tz qx qy qz qw    (camera to world; scalar last)

Lines with ``#`` are comments. Depth is in 1/5000 m, unless the scene says otherwise (many
tools write millimetres: ``depth_scale`` 0.001). Colour and depth have separate
clock ticks: a colour and a depth image that are each other's nearest within 20 ms share a frame number, and every other
image has its own. A folder with neither ``rgb.txt`` nor a folder ``rgb`` holds depth only. The layout holds no
intrinsics: the scene gives them. ``"source": {"trajectory": "left", "closed":
true}`` reads groundtruth.txt as the path of the gripper "left" instead, for those who track the hand.

Text carries no checksum: a changed digit that stays plausible goes unnoticed, and so do changed bytes in the pixels of
a JPEG. PNG files are verified.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...errors import RecordingError
from .. import checks
from ..files import is_present
from ..images import ImageKind, ImageStream
from .imported import (
    MAX_SHOWN_CHARACTERS,
    FileImages,
    Imported,
    ImportedCamera,
    Importer,
    check_depth_scale,
    image_size,
    pair_frames,
    parse_nanoseconds,
    read_text,
    reject_unknown_keys,
    require_fixed_pose,
    to_pose_matrices,
    to_seconds,
)
from .scene_file import SceneFile

TUM_NAME = "tum"
TUM_TITLE = "TUM RGB-D folder"
TUM_CAMERA_NAME = "cam0"
TUM_UNCHECKED = "times, poses, and pixels of JPEG images"
TUM_DEPTH_SCALE_M = 1 / 5000  # per unit, by definition of the layout
IMAGE_LIST_FILES: dict[ImageKind, str] = {"color": "rgb.txt", "depth": "depth.txt"}
COLOR_FOLDER = "rgb"
GROUND_TRUTH_FILE = "groundtruth.txt"


def matches(path: Path) -> bool:
    """Return whether a folder has this layout, with or without colour."""
    return is_present(path / IMAGE_LIST_FILES["depth"]) and not describe_missing(path)


def describe_missing(path: Path) -> str:
    """Return which image list a folder lacks that has another one; without colour images it needs no list of them."""
    if not path.is_dir():
        return ""
    present = [file for file in IMAGE_LIST_FILES.values() if is_present(path / file)]
    missing = sorted(set(IMAGE_LIST_FILES.values()) - set(present))
    if missing == [IMAGE_LIST_FILES["color"]] and not is_present(path / COLOR_FOLDER):
        return ""
    return f"a TUM RGB-D folder needs {' and '.join(missing)} beside {present[0]}" if present and missing else ""


def read(path: Path, scene: SceneFile, episode: int | None) -> Imported:
    """Read the folder; the images are checked when they are copied.

    Args:
        path: the folder.
        scene: the scene file.
        episode: unused; a folder holds one episode.

    Raises:
        RecordingError: the folder is damaged or incomplete.
    """
    source = scene.source
    name = source.optional(source.text, "camera") or TUM_CAMERA_NAME
    hand = source.optional(source.text, "trajectory")
    closed = source.optional(source.take, "closed") if hand is not None else None
    reject_unknown_keys(source)
    lists: dict[ImageKind, list[tuple[int, Path]]] = {
        kind: _list(path, file) for kind, file in IMAGE_LIST_FILES.items() if is_present(path / file)
    }
    stamps: dict[ImageKind, np.ndarray] = {
        kind: np.array([ns for ns, _ in rows], dtype=np.int64) for kind, rows in lists.items()
    }
    truth = _truth(path / GROUND_TRUTH_FILE) if is_present(path / GROUND_TRUTH_FILE) else None
    start = int(min(t[0] for t in stamps.values()))
    numbers: dict[ImageKind, np.ndarray] = {"depth": np.arange(len(stamps["depth"]))}
    if "color" in stamps:
        numbers["color"], numbers["depth"] = pair_frames(stamps["color"], stamps["depth"])
    size = image_size(lists["depth"][0][1])
    stated_scale = scene.depth_scale(name)
    scale = stated_scale or TUM_DEPTH_SCALE_M
    camera = ImportedCamera({"width": size[0], "height": size[1], "depth_scale": scale})
    for kind, rows in lists.items():
        source_of = FileImages([file for _, file in rows])
        camera.streams[kind] = ImageStream(kind, numbers[kind], to_seconds(stamps[kind], start), (), size, source_of)
    check_depth_scale(camera.streams["depth"], scale, lists["depth"][0][1], is_assumed=stated_scale is None)
    imported = Imported(
        cameras={name: camera}, notes={"format": TUM_NAME, "start_ns": start, "unchecked": TUM_UNCHECKED}
    )
    if truth is not None and hand is None:
        remedy = f'if {GROUND_TRUTH_FILE} tracks a gripper, write "source": {{"trajectory": "left", "closed": true}}'
        poses = to_pose_matrices(truth[1], truth[2], str(path / GROUND_TRUTH_FILE))
        camera.calibration["T_world_camera"] = require_fixed_pose(poses, str(path / GROUND_TRUTH_FILE), remedy=remedy)
    elif truth is not None and hand is not None:
        if not isinstance(closed, bool):
            raise RecordingError(f"{source.location('closed')} is unclear", got=closed, expected="true or false")
        t = to_seconds(truth[0], start)
        imported.motion[hand] = {"t": t, "position": truth[1], "quat_wxyz": truth[2], "closed": np.full(len(t), closed)}
    elif hand is not None:
        raise RecordingError(f"{path / GROUND_TRUTH_FILE} is missing", expected=f"the path of {hand!r}")
    return imported


def _rows(file: Path, columns: int) -> list[list[str]]:
    rows = [line.split() for line in read_text(file).splitlines() if line.strip() and not line.lstrip().startswith("#")]
    wrong = next((row for row in rows if len(row) != columns), None)
    if not rows or wrong:
        got = "no line" if not rows else repr(" ".join(wrong or [])[:MAX_SHOWN_CHARACTERS])
        raise RecordingError(f"{file} is damaged", got=got, expected=f"lines of {columns} words")
    return rows


def _stamps(rows: list[list[str]], file: Path) -> np.ndarray:
    stamps = np.array([parse_nanoseconds(row[0], str(file)) for row in rows], dtype=np.int64)
    checks.check_increasing(to_seconds(stamps, int(stamps[0])), str(file))
    return stamps


def _list(folder: Path, name: str) -> list[tuple[int, Path]]:
    """Time and path of each image; a path may not leave the folder, and no image may occur twice."""
    rows = _rows(folder / name, 2)
    files = [row[1] for row in rows]
    outside = next((f for f in files if Path(f).is_absolute() or ".." in Path(f).parts or "\0" in f), None)
    if outside is not None or len(set(files)) < len(files):
        got = outside or "a file listed twice"
        raise RecordingError(f"{folder / name} names wrong files", got=repr(got), expected="images below the folder")
    parents = {((folder / f).parent, Path(f).suffix) for f in files}
    images = {p for parent, suffix in parents for p in parent.glob("*") if p.suffix == suffix}
    unlisted = sorted(images - {folder / f for f in files})
    if unlisted:
        got, expected = f"{unlisted[0].name} not listed", "every image; the list may have been cut"
        raise RecordingError(f"{folder / name} is incomplete", got=got, expected=expected, remedy="list or remove it")
    return list(zip(_stamps(rows, folder / name).tolist(), (folder / f for f in files), strict=True))


def _truth(file: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times [N] ns, positions [N, 3] m, quaternions [N, 4] scalar first."""
    rows = _rows(file, 8)
    try:
        values = np.array([[float(word) for word in row[1:]] for row in rows])
    except ValueError as error:
        raise RecordingError(f"{file} is damaged", got=error, expected="numbers") from error
    values = checks.check_array(values, str(file), ("N", 7))
    checks.check_metres(values[:, :3], str(file))
    quat = values[:, [6, 3, 4, 5]]
    checks.normalise_unit(quat, str(file))
    return _stamps(rows, file), values[:, :3], quat


TUM_IMPORTER = Importer(TUM_NAME, TUM_TITLE, matches, read, describe_missing)
