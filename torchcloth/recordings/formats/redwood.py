"""RGB-D folders in the layout of Open3D and the Redwood data sets.

    [color/*.jpg|png]  depth/*.png  camera_intrinsic.json|intrinsic.json  [trajectory.log]

The intrinsic matrix in Open3D's JSON is stored column by column. The poses in a ``.log`` are camera-to-world, of a
camera in the OpenCV convention. Depth is in millimetres unless the file says otherwise. Times are in the names of
Redwood's images (``FRAME-MICROSECONDS.png``). Open3D's own images carry none; then ``fps`` comes from the intrinsic
file that its recorders write, or from the scene. Images are pairs in the order of their names.

Text carries no checksum: a changed digit in the intrinsic or pose files goes unnoticed if it stays plausible, and so do
changed bytes in the pixels of a JPEG. PNG files are verified.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import RecordingError
from .. import checks
from ..files import Folder, is_present
from ..images import ImageKind, ImageStream
from .imported import (
    NANOSECONDS_PER_SECOND,
    FileImages,
    Imported,
    ImportedCamera,
    Importer,
    check_depth_scale,
    image_size,
    read_text,
    reject_unknown_keys,
    require_fixed_pose,
    to_seconds,
)
from .scene_file import SceneFile

REDWOOD_NAME = "redwood"
REDWOOD_TITLE = "Open3D/Redwood RGB-D folder"
COLOR_FOLDERS, INTRINSIC_FILES = ("color", "rgb", "image"), ("camera_intrinsic.json", "intrinsic.json", "camera.json")
TRAJECTORY_FILES = ("trajectory.log", "scene/trajectory.log")
REDWOOD_CAMERA_NAME = "cam0"
REDWOOD_UNCHECKED = "intrinsics, pose, and pixels of JPEG images"
REDWOOD_DEPTH_SCALE_M = 0.001
MAX_PAIR_DELAY_NS = 50_000_000  # between the images of a pair
_STAMPED_NAME_PATTERN = re.compile(r"\d+-(\d{6,15})")


def matches(path: Path) -> bool:
    """Return whether a folder has this layout, with or without colour."""
    return _has_folder(path, "depth") and any(is_present(path / name) for name in INTRINSIC_FILES)


def describe_missing(path: Path) -> str:
    """Return what a folder lacks that has a folder of depth images."""
    if not _has_folder(path, "depth") or any(is_present(path / name) for name in ("rgb.txt", "depth.txt")):
        return ""
    return "" if matches(path) else f"an Open3D/Redwood RGB-D folder needs {' or '.join(INTRINSIC_FILES)} beside depth"


def _has_folder(path: Path, name: str) -> bool:
    return is_present(path / name) and (path / name).is_dir()


def read(path: Path, scene: SceneFile, episode: int | None) -> Imported:
    """Read the folder; the images are checked when they are copied.

    Args:
        path: the folder.
        scene: the scene file.
        episode: unused; a folder holds one episode.

    Raises:
        RecordingError: the folder is damaged, or its images are not pairs.
    """
    source = scene.source
    name = source.optional(source.text, "camera") or REDWOOD_CAMERA_NAME
    fps = source.optional(source.number, "fps", above=0, maximum=1000, suspect="milliseconds")
    reject_unknown_keys(source)
    camera, fps = _camera(path, fps)
    camera.calibration.setdefault("depth_scale", scene.depth_scale(name) or REDWOOD_DEPTH_SCALE_M)
    depth = _images(path / "depth", (".png",))
    images: dict[ImageKind, list[Path]] = {"depth": depth}
    color_folder = next((n for n in COLOR_FOLDERS if _has_folder(path, n)), None)
    if color_folder is not None:
        images["color"] = _images(path / color_folder, (".jpg", ".jpeg", ".png"))
    times = {kind: _times(paths, fps) for kind, paths in images.items()}
    if "color" in images:
        _check_pairs(path, images["color"], times["color"], times["depth"])
    start = int(min(t[0] for t in times.values()))
    size = camera.calibration["width"], camera.calibration["height"]
    for kind, paths in images.items():
        numbers = np.arange(len(paths))
        stream = ImageStream(kind, numbers, to_seconds(times[kind], start), (), size, FileImages(paths))
        camera.streams[kind] = stream
    if image_size(depth[0]) != size:
        raise RecordingError(f"{depth[0]} has the wrong size", got=image_size(depth[0]), expected=f"{size}")
    check_depth_scale(camera.streams["depth"], camera.calibration["depth_scale"], depth[0], is_assumed=False)
    notes: dict[str, Any] = {"format": REDWOOD_NAME, "start_ns": start, "unchecked": REDWOOD_UNCHECKED}
    if color_folder is None:
        notes["repairs"] = [f"depth only: there is no folder {' or '.join(COLOR_FOLDERS)}"]
    imported = Imported(cameras={name: camera}, notes=notes)
    log = next((path / n for n in TRAJECTORY_FILES if is_present(path / n)), None)
    if log is not None:
        camera.calibration["T_world_camera"] = require_fixed_pose(_poses(log, len(depth)), str(log))
    return imported


def _check_pairs(path: Path, color: list[Path], color_ns: np.ndarray, depth_ns: np.ndarray) -> None:
    """Refuse images that are not pairs of colour and depth."""
    what = f"{path} is not made of pairs"
    if len(color_ns) != len(depth_ns):
        got = f"{len(color_ns)} colour and {len(depth_ns)} depth images"
        raise RecordingError(what, got=got, expected="as many of each")
    apart = np.abs(color_ns - depth_ns)
    if apart.max() > MAX_PAIR_DELAY_NS:
        name_of_worst = color[int(apart.argmax())].name
        got = f"{apart.max() / NANOSECONDS_PER_SECOND:.3g} s between {name_of_worst} and its depth image"
        raise RecordingError(what, got=got, expected=f"at most {MAX_PAIR_DELAY_NS / NANOSECONDS_PER_SECOND:g} s")


def _camera(path: Path, fps: float | None) -> tuple[ImportedCamera, float | None]:
    """Intrinsics, and what Open3D's recorders add: the rate and the depth scale."""
    file = path / next(n for n in INTRINSIC_FILES if is_present(path / n))
    fields = Folder(file.parent).read_json(file.name)
    flat = fields.array("intrinsic_matrix", 9)
    K = flat.reshape(3, 3).T
    if min(K[0, 0], K[1, 1]) <= 0 or not np.array_equal(K[[1, 2, 2, 2], [0, 0, 1, 2]], [0, 0, 0, 1]):
        got, expected = flat.tolist(), "[fx, 0, 0, s, fy, 0, cx, cy, 1], column by column as Open3D writes it"
        raise RecordingError(f"{fields.location('intrinsic_matrix')} is no camera matrix", got=got, expected=expected)
    width, height = fields.whole_number("width"), fields.whole_number("height")
    if not (0 < K[0, 2] < width and 0 < K[1, 2] < height):
        got = f"principal point {K[:2, 2].tolist()} in {width} x {height} pixels"
        raise RecordingError(f"{fields.location('intrinsic_matrix')} looks away from the image", got=got)
    known: dict[str, Any] = {"width": width, "height": height, "K": K}
    units = fields.optional(fields.number, "depth_scale", above=0, maximum=1e6, suspect="metres per unit")
    if units is not None:
        known["depth_scale"] = 1 / units  # Open3D stores units per metre
    rate = fields.optional(fields.number, "fps", above=0, maximum=1000, suspect="milliseconds")
    if rate is not None and fps is not None and rate != fps:
        raise RecordingError("source.fps contradicts the file", got=fps, expected=f"{rate:g}", remedy="leave it out")
    return ImportedCamera(known), rate or fps


def _images(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    paths = sorted(p for p in folder.iterdir() if is_present(p) and p.is_file())
    wrong = [p for p in paths if p.suffix.lower() not in suffixes]
    if not paths or wrong:
        got = wrong[0].name if wrong else "no image"
        raise RecordingError(f"{folder} is no image folder", got=got, expected=f"only {' '.join(suffixes)} files")
    numbers = [re.match(r"\D*(\d+)", p.stem) for p in paths]
    if any(n is None for n in numbers):
        raise RecordingError(f"{folder} holds unnumbered images", got=paths[0].name, expected="frame numbers as names")
    order = [int(n.group(1)) for n in numbers if n]
    lengths = [len(p.stem) for p in paths]
    wrong = (np.diff(order) != 1) | (np.diff(lengths) != 0)
    if wrong.any():
        i = int(np.argmax(wrong))
        got = f"{paths[i].name} then {paths[i + 1].name}"
        raise RecordingError(f"{folder} misses an image", got=got, expected="consecutive numbers, of one length")
    return paths


def _times(paths: list[Path], fps: float | None) -> np.ndarray:
    stamps = [_STAMPED_NAME_PATTERN.fullmatch(p.stem) for p in paths]
    if all(stamps):
        return np.array([int(s.group(1)) * 1000 for s in stamps if s])
    if any(stamps):
        raise RecordingError(f"{paths[0].parent}: some names carry a time", expected="all or none")
    if fps is None:
        expected = 'the scene with "source": {"fps": 30}'
        raise RecordingError(f"{paths[0].parent}: the images carry no times", expected=expected)
    return np.round(np.arange(len(paths)) * (NANOSECONDS_PER_SECOND / fps)).astype(np.int64)


def _poses(log: Path, count: int) -> np.ndarray:
    """Camera-to-world poses [N, 4, 4]; each follows a line ``i j n``."""
    lines = [line.split() for line in read_text(log).splitlines() if line.strip()]
    blocks = [lines[i : i + 5] for i in range(0, len(lines), 5)]
    try:
        heads = [[int(word) for word in block[0]] for block in blocks]
        poses = np.array([[[float(word) for word in row] for row in block[1:]] for block in blocks])
    except ValueError as error:
        raise RecordingError(f"{log} is damaged", got=error, expected="i j n and four rows of four numbers") from error
    poses = checks.check_array(poses, str(log), (count, 4, 4))
    if any(head[:2] != [i, i] for i, head in enumerate(heads)):
        raise RecordingError(f"{log} is not in order", expected=f"frames 0 to {count - 1}, one pose each")
    return poses


REDWOOD_IMPORTER = Importer(REDWOOD_NAME, REDWOOD_TITLE, matches, read, describe_missing)
