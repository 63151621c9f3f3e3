"""LeRobot data sets, version 3, read by pyarrow and PyAV.

    meta/info.json  meta/episodes/**.parquet  data/**.parquet  videos/KEY/**.mp4

One file holds many episodes: ``--episode N`` chooses one. The columns of a vector are named in info.json. Their meaning
and unit must be given by the user:

    "source": {"motion": {"left": {"column": "observation.state", "joints": ["j1.pos", ...], "unit": "rad" | "deg",
                                   "width": "gripper.width", "width_scale": 1.0, "closed": true}},
               "cameras": {"cam0": {"color": "observation.images.top"}}}

Joints and width are names (of info.json) or indices. Times are those of the data set's regular clock, or the
``timestamp`` column if it holds the hardware's times.

Checked are: page checksums if there are any; one row and one video frame for every tick of the clock; and smallest,
largest and mean value of every column against the statistics that LeRobot stores for each episode. Changed bytes that
decode to another picture are not detected, for AV1 and H.264 carry no checksum.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from ..._utils.unpacking import check_unpacked_size
from ...errors import MissingDependency, RecordingError
from .. import checks
from ..checks import Fields
from ..files import Folder, is_present
from ..images import ImageStream
from .imported import NANOSECONDS_PER_SECOND, Imported, ImportedCamera, Importer, reject_unknown_keys, report_damage
from .scene_file import SceneFile
from .video import VideoFrames

LEROBOT_NAME = "lerobot"
LEROBOT_TITLE = "LeRobot v3 data set"
INFO_FILE = "meta/info.json"
PATH_TEMPLATE_PATTERN = re.compile(r"([^{}]|\{\w+(:\d{0,2}d?)?\})*")  # a wider field could fill the memory
LEROBOT_SOURCE_EXAMPLE = (
    '"source": {"motion": {"left": {"column": "observation.state", "joints": [0, 1, 2], "unit": "rad"}}}'
)
PARQUET_VALUE_BYTES = 8  # of a number; equal ones may take no space in the file
LEROBOT_UNCHECKED = "pixels"
LEROBOT_TIME_TOLERANCE_S = 1e-4  # LeRobot's own for video and row times
MAX_JITTER_FRACTION = 0.9  # of the clock's interval, by which an interval of the hardware may differ
MIN_JITTERING_FRACTION = 0.3  # of the intervals; a few irregular ones are damage
MAX_VIDEO_DURATION_S = 1e6  # of one file
STATISTICS_TOLERANCE = 1e-5  # relative; statistics are stored in float64, values in float32
FLOAT32_ROUNDING = 2.0**-24  # error per row of a float32 sum; means are computed from such sums


def matches(path: Path) -> bool:
    """Return whether a folder has this layout."""
    return is_present(path / INFO_FILE)


def read(path: Path, scene: SceneFile, episode: int | None) -> Imported:
    """Read one episode; video is decoded when it is written.

    Args:
        path: folder of the data set.
        scene: the scene file with ``source``.
        episode: which one; None if there is only one.

    Raises:
        RecordingError: the data set is damaged, or the scene maps no column or a wrong one.
    """
    info = _info(path)
    row = _episode(path, episode)
    fps = info.number("fps", above=0, maximum=10_000, suspect="milliseconds")
    features = info.group("features")
    table = _table(path, info, features, row, fps)
    source = scene.source
    if not source.remaining:
        expected = f"the scene with {LEROBOT_SOURCE_EXAMPLE}"
        raise RecordingError(
            f"{path}: no column is mapped", got=f"columns {sorted(features.remaining)}", expected=expected
        )
    imported = Imported(
        notes={"format": LEROBOT_NAME, "episode": int(row["episode_index"]), "fps": fps, "unchecked": LEROBOT_UNCHECKED}
    )
    ticks = np.arange(len(table["frame_index"])) / fps
    t = _times(table, row, ticks, str(path))
    if t is not ticks:
        imported.notes["repairs"] = [f"times are those of the column timestamp, not of the clock of {fps:g} Hz"]
    for name, fields in source.named_groups("motion").items():
        imported.motion[name] = _motion(fields, features, table, row, t)
    for name, fields in source.named_groups("cameras").items():
        imported.cameras[name] = _camera(path, fields, info, features, row, ticks, t)
    reject_unknown_keys(source)
    return imported


def _info(path: Path) -> Fields:
    info = Folder(path / "meta").read_json("info.json")
    version = info.text("codebase_version")
    if not version.startswith("v3."):
        remedy = "convert it with lerobot's own script first"
        raise RecordingError(
            f"{path / INFO_FILE}: another version", got=repr(version), expected="'v3.*'", remedy=remedy
        )
    return info


def _read_table(file: Path, *, columns: list[str] | None = None, episode: int | None = None) -> dict[str, list[Any]]:
    """Columns of a parquet file, of one episode or all; page checksums are verified if there are any."""
    try:
        from pyarrow import parquet  # pyright: ignore[reportMissingImports]  (optional)
    except ImportError as error:
        raise MissingDependency("reading LeRobot needs pyarrow", remedy='pip install "torchcloth[data]"') from error
    if not is_present(file):
        raise RecordingError(f"{file} is missing", expected="a parquet file", remedy="download it")
    with report_damage(file, "parquet file"):
        parts = parquet.read_metadata(file)
        groups = map(parts.row_group, range(parts.num_row_groups))
        values = sum(group.column(i).num_values for group in groups for i in range(parts.num_columns))
        check_unpacked_size(values * PARQUET_VALUE_BYTES, file.stat().st_size, str(file))
        rows = None if episode is None else [("episode_index", "=", episode)]
        table = parquet.read_table(file, columns=columns, filters=rows, page_checksum_verification=True)
        table.validate(full=True)
        return table.to_pydict()


def _episode(path: Path, episode: int | None) -> dict[str, Any]:
    """Row about one episode in meta/episodes."""
    files: dict[int, Path] = {}
    for file in sorted((path / "meta" / "episodes").rglob("*.parquet")):
        for index in _read_table(file, columns=["episode_index"]).get("episode_index", [None]):
            if index in files or not isinstance(index, int):
                raise RecordingError(f"{file} lists an episode twice or not at all", got=index, expected="numbers")
            files[index] = file
    chosen = next(iter(files)) if len(files) == 1 and episode is None else episode
    if chosen not in files:
        known = sorted(files)
        got = "no --episode" if episode is None else f"--episode {episode}"
        expected = f"one of {known[0]} to {known[-1]}" if known else "meta/episodes"
        raise RecordingError(f"{path} holds {len(files)} episodes", got=got, expected=expected)
    columns = _read_table(files[chosen], episode=chosen)
    if columns.get("episode_index") != [chosen]:
        raise RecordingError(f"{files[chosen]} has lost episode {chosen}", remedy="download it again")
    return {key: values[0] for key, values in columns.items()} | {"file": str(files[chosen])}


def _table(path: Path, info: Fields, features: Fields, row: dict[str, Any], fps: float) -> dict[str, np.ndarray]:
    """The episode's rows, which must be one for each tick."""
    file = path / _file(info, "data_path", row, "data")
    number, length = row["episode_index"], _whole(row, "length")
    plain = [key for key, feature in features.remaining.items() if _dtype(feature) not in ("video", "image", "string")]
    columns = _read_table(file, columns=plain, episode=number)
    place = f"{file}: episode {number}"
    with report_damage(place, "table"):
        table = {key: np.asarray(values) for key, values in columns.items()}
    first = _whole(row, "dataset_from_index")
    expected = {
        "frame_index": np.arange(length),
        "index": np.arange(first, first + length),
    }
    for key, values in expected.items():
        column = checks.check_array(table.get(key), f"{place}, {key}", (length,))
        if not np.array_equal(column, values):
            i = int(np.argmax(np.abs(column - values)))
            got = f"{column[i]:g} in row {i}"
            raise RecordingError(f"{place}, {key} is not regular", got=got, expected=f"{values[i]:g}")
    if _whole(row, "dataset_to_index") - first != length:
        raise RecordingError(f"{row['file']} contradicts itself", got=f"length {length}", expected="its indices")
    return table


def _times(table: dict[str, np.ndarray], row: dict[str, Any], ticks: np.ndarray, path: str) -> np.ndarray:
    """Times of the rows: ``ticks``, or the column ``timestamp`` where it holds the hardware's times, which jitter."""
    place = f"{path}: episode {row['episode_index']}, timestamp"
    t = checks.check_array(table.get("timestamp"), place, ticks.shape)
    if np.allclose(t, ticks, rtol=0, atol=LEROBOT_TIME_TOLERANCE_S):
        return ticks
    checks.check_increasing(t, place)
    step, interval = np.diff(t), ticks[1] if len(ticks) > 1 else 0.0
    off = np.abs(step - interval) > MAX_JITTER_FRACTION * interval
    jitters = (np.abs(step - interval) > LEROBOT_TIME_TOLERANCE_S).mean() if len(step) else 0.0
    if off.any() or jitters < MIN_JITTERING_FRACTION:
        i = int(np.argmax(np.abs(t - ticks)))
        raise RecordingError(f"{place} is not regular", got=f"{t[i]:g} in row {i}", expected=f"{ticks[i]:g}")
    _check_statistics(t[:, None], row, "timestamp")
    return t


def _motion(fields: Fields, features: Fields, table: dict, row: dict[str, Any], t: np.ndarray) -> dict[str, np.ndarray]:
    """The arrays of motion.npz for one arm."""
    column = fields.text("column")
    names = _names(features, column, fields)
    values = checks.check_array(table.get(column), f"{fields.location('column')} {column}", (len(t), len(names)))
    _check_statistics(values, row, column)
    unit = fields.text("unit")
    if unit not in ("rad", "deg"):
        raise RecordingError(f"{fields.location('unit')} is unknown", got=repr(unit), expected="rad or deg")
    joints = fields.take("joints")
    if not isinstance(joints, list) or not joints:
        raise RecordingError(
            f"{fields.location('joints')} is unclear", got=joints, expected="names or indices, in order"
        )
    q = values[:, [_index(j, names, fields.location("joints")) for j in joints]]
    out = {"t": t, "q": np.radians(q) if unit == "deg" else q}
    width = fields.optional(fields.take, "width")
    scale = fields.optional(fields.number, "width_scale", above=0) or 1.0
    if width is not None:
        out["width"] = values[:, _index(width, names, fields.location("width"))] * scale
    closed = fields.optional(fields.take, "closed")
    if closed is not None:
        if not isinstance(closed, bool):
            raise RecordingError(f"{fields.location('closed')} is unclear", got=closed, expected="true or false")
        out["closed"] = np.full(len(t), closed)
    reject_unknown_keys(fields)
    return out


def _dtype(feature: Any) -> Any:
    return feature.get("dtype") if isinstance(feature, dict) else None


def _names(features: Fields, column: str, fields: Fields) -> list[str]:
    """Names of a vector's entries; numbers if it has none."""
    if not features.has(column):
        raise RecordingError(
            f"{fields.location('column')} is unknown", got=repr(column), expected=f"{sorted(features.remaining)}"
        )
    feature = Fields(features.remaining[column], features.location(column))
    shape = feature.array("shape", "N", kind="int").tolist()
    if len(shape) != 1:
        raise RecordingError(f"{features.location(column)} is no vector", got=shape, expected="one dimension")
    names = feature.remaining.get("names")
    if isinstance(names, dict):  # lerobot also writes {"motors": [...]}
        names = next(iter(names.values()), None)
    if names is None:
        return [str(i) for i in range(shape[0])]
    if not isinstance(names, list) or len(names) != shape[0] or len({str(n) for n in names}) != shape[0]:
        raise RecordingError(f"{features.location(column)}.names do not fit", got=names, expected=f"{shape[0]} names")
    return [str(n) for n in names]


def _index(word: Any, names: list[str], place: str) -> int:
    if isinstance(word, str) and word in names:
        return names.index(word)
    if isinstance(word, int) and not isinstance(word, bool) and 0 <= word < len(names):
        return word
    raise RecordingError(f"{place} is unknown", got=repr(word), expected=f"one of {', '.join(names)}")


def _check_statistics(values: np.ndarray, row: dict[str, Any], column: str) -> None:
    """Check a column against the statistics that LeRobot stored when it recorded."""
    size, rounding = np.abs(values).max() + 1e-9, len(values) * FLOAT32_ROUNDING
    for name, computed in (("min", values.min(axis=0)), ("max", values.max(axis=0)), ("mean", values.mean(axis=0))):
        stored = row.get(f"stats/{column}/{name}")
        if stored is None:
            continue
        stored = checks.check_array(stored, f"{row['file']}: stats/{column}/{name}", computed.shape)
        if np.abs(stored - computed).max() > max(STATISTICS_TOLERANCE, rounding if name == "mean" else 0.0) * size:
            i = int(np.argmax(np.abs(stored - computed)))
            got, expected = f"a {name} of {computed[i]:.9g} in entry {i}", f"{stored[i]:.9g}, as recorded"
            raise RecordingError(f"{column} contradicts its statistics", got=got, expected=expected)


def _camera(
    path: Path,
    fields: Fields,
    info: Fields,
    features: Fields,
    row: dict[str, Any],
    ticks: np.ndarray,
    t: np.ndarray,
) -> ImportedCamera:
    """A camera whose colour images are a section of a video, which runs by ``ticks``; they were taken at ``t``."""
    key = fields.text("color")
    reject_unknown_keys(fields)
    if not features.has(key):
        raise RecordingError(
            f"{fields.location('color')} is unknown", got=repr(key), expected=f"{sorted(features.remaining)}"
        )
    feature = Fields(features.remaining[key], features.location(key))
    if _dtype(feature.remaining) != "video":
        raise RecordingError(f"{features.location(key)} is no video", got=_dtype(feature.remaining), expected="video")
    names: Any = feature.remaining.get("names")
    shape: dict[Any, int] = dict(zip(names or (), feature.array("shape", 3, kind="int").tolist(), strict=False))
    if not {"height", "width"} <= shape.keys():
        raise RecordingError(f"{feature.location('names')} are unclear", got=names, expected="height, width, channels")
    size = shape["width"], shape["height"]
    file = path / _file(info, "video_path", row, f"videos/{key}", video_key=key)
    if not is_present(file):
        raise RecordingError(f"{file} is missing", expected="a video", remedy="download it")
    start = row.get(f"videos/{key}/from_timestamp")
    end = row.get(f"videos/{key}/to_timestamp")
    span = checks.check_array([start, end], f"{row['file']}: videos/{key}", (2,))
    step = ticks[1] if len(ticks) > 1 else span[1] - span[0]
    if (
        not 0 <= span[0] <= MAX_VIDEO_DURATION_S
        or abs(span[1] - span[0] - len(t) * step) > LEROBOT_TIME_TOLERANCE_S * 10
    ):
        got = f"{span[1] - span[0]:g} s for {len(t)} frames"
        raise RecordingError(f"{row['file']}: videos/{key} does not last", got=got, expected=f"{len(t) * step:g} s")
    times = np.round((span[0] + ticks) * NANOSECONDS_PER_SECOND).astype(np.int64)
    frames = VideoFrames(file, 0, "color", times, round(LEROBOT_TIME_TOLERANCE_S * NANOSECONDS_PER_SECOND))
    stream = ImageStream("color", np.arange(len(t)), t, (), size, frames)
    return ImportedCamera({"width": size[0], "height": size[1]}, {"color": stream})


def _file(info: Fields, key: str, row: dict[str, Any], group: str, **names: str) -> str:
    """Path from its template in info.json."""
    template = str(info.remaining.get(key, ""))
    numbers = {n: _whole(row, f"{group}/{n}") for n in ("chunk_index", "file_index")}
    if not PATH_TEMPLATE_PATTERN.fullmatch(template):
        expected = "a path with fields such as {chunk_index:03d}"
        raise RecordingError(f"{info.location(key)} is no path template", got=repr(template), expected=expected)
    with report_damage(info.location(key), "path template"):
        path = template.format(**numbers, **names)
    if not path or Path(path).is_absolute() or ".." in Path(path).parts:
        raise RecordingError(f"{info.location(key)} leaves the data set", got=repr(template))
    return path


def _whole(row: dict[str, Any], key: str) -> int:
    value = row.get(key)
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        raise RecordingError(f"{row['file']}: {key} is no number", got=repr(value), expected="a whole number")
    return value


LEROBOT_IMPORTER = Importer(LEROBOT_NAME, LEROBOT_TITLE, matches, read)
