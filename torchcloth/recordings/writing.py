"""Writer of an episode folder, which is read back before it is put in its place."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import fields
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from ..errors import InvalidInput, RecordingError
from ..meshes import obj
from . import checks, images, streams
from .atomic_write import write_folder_atomically
from .consistency import check_recording
from .files import Folder, save_npz
from .reading import EPISODE_FILE, EPISODE_FORMAT, EPISODE_SCHEMA, EPISODE_VERSION, read_folder
from .robot_files import copy_robot_files
from .types import Camera, ClothInfo, GraspInfo, Recording

MESH_FILE, INITIAL_VERTICES_FILE, INITIAL_VELOCITIES_FILE = "cloth.obj", "cloth_initial.npy", "cloth_velocities.npy"
POINT_SCALE_M = 1e-4  # resolution of compact points; far below any sensor's noise


def write(
    recording: Recording,
    path: str | Path,
    *,
    overwrite: bool = False,
    compact: bool = True,
    on_image: Callable[[], None] = lambda: None,
    attachments: Mapping[str, bytes] = MappingProxyType({}),
) -> Path:
    """Write an episode folder atomically; a recording that cannot be read back is refused.

    The final name only ever holds a complete episode. Overwriting moves the old folder aside first and moves it back if
    anything fails (after a power cut it lies next to it as ``.NAME.*.old``). Files in it that the recording does not
    hold, such as truth that was not read, are removed. URDF files that it names are copied into the episode.

    Args:
        recording: to write.
        path: the episode folder.
        overwrite: replace an existing episode; a folder that is not an episode is never replaced.
        compact: store points in tenths of a millimetre (int16) if they fit, else as float32.
        on_image: called after each image, for a progress bar.
        attachments: further files by name, such as a picture, which no reader looks at.

    Returns:
        The path of the episode.

    Raises:
        RecordingError: the target exists, or the recording would be refused by ``read``, or the disk fails.
    """
    check_recording(recording)

    def fill(part: Path, shown: Path) -> None:
        for name, content in attachments.items():
            (part / checks.check_name(name, f"attachments[{name!r}]")).write_bytes(content)
        _fill(part, recording, compact, on_image)
        read_folder(Folder(part, display_path=shown), with_truth=True)

    return write_folder_atomically(Path(path), fill, marker=EPISODE_FILE, overwrite=overwrite)


def _fill(part: Path, recording: Recording, compact: bool, on_image: Callable[[], None]) -> None:
    if recording.cloth is None:
        raise InvalidInput("recording.cloth", got="None", expected="a ClothInfo: what the cloth is")
    recording = copy_robot_files(recording, part)
    text = json.dumps(build_episode_json(recording), indent=1, allow_nan=False, default=to_json_value)
    (part / EPISODE_FILE).write_text(text + "\n", encoding="utf-8")
    _write_cloth(part, recording.cloth)
    if motion := build_motion_arrays(recording):
        save_npz(part / streams.MOTION_FILE, motion)
    if recording.points is not None:
        save_npz(part / streams.POINTS_FILE, _point_arrays(bag_fields(recording.points), compact))
    if recording.markers is not None:
        save_npz(part / streams.MARKERS_FILE, bag_fields(recording.markers))
    if recording.truth is not None:
        save_npz(part / streams.TRUTH_FILE, bag_fields(recording.truth))
    for name, camera in recording.cameras.items():
        _write_images(part / checks.check_name(name, f"cameras[{name!r}]"), camera, on_image)


def build_episode_json(recording: Recording) -> dict[str, Any]:
    """Build the object of episode.json."""
    known = {
        "schema": EPISODE_SCHEMA,
        "format": EPISODE_FORMAT,
        "version": EPISODE_VERSION,
        "cloth": _cloth(recording.cloth),
        "grasps": {name: _grasp(g) for name, g in recording.grasps.items()},
        "colliders": {
            name: _with(c.extra, plane={"point": c.point, "normal": c.normal}, friction=c.friction)
            for name, c in recording.colliders.items()
        },
        "robots": {name: bag_fields(r) for name, r in recording.robots.items()},
        "cameras": {name: bag_fields(c, skip=images.IMAGE_KINDS) for name, c in recording.cameras.items()},
        "observation_noise": _with({}, std=recording.observation_noise_std),
        "clock_offset": recording.clock_offset,
        "gravity": recording.gravity,
        "air": _with({}, density=recording.air_density),
        "split": recording.split,
        "provenance": recording.provenance,
        "licence": recording.licence,
    }
    return _with(recording.extra, **known)


def _cloth(cloth: ClothInfo) -> dict[str, Any]:
    known = {
        "mesh": None if cloth.vertices is None else MESH_FILE,
        "sheet": None if cloth.sheet is None else {"width": cloth.sheet[0], "height": cloth.sheet[1]},
        "initial_vertices": None if cloth.initial_vertices is None else INITIAL_VERTICES_FILE,
        "initial_velocities": None if cloth.initial_velocities is None else INITIAL_VELOCITIES_FILE,
    }
    plain = ("areal_density", "areal_density_std", "thickness", "layer_gap", "nominal")
    return _with(cloth.extra, **known, **{key: getattr(cloth, key) for key in plain})


def _grasp(grasp: GraspInfo) -> dict[str, Any]:
    return bag_fields(grasp, skip=("radius",) if grasp.uv is None else ())


def _write_cloth(part: Path, cloth: ClothInfo) -> None:
    if cloth.vertices is not None:
        if cloth.faces is None:
            raise RecordingError("cloth.faces is missing", expected="[F, 3] beside cloth.vertices")
        (part / MESH_FILE).write_text(obj.dump(cloth.vertices, cloth.faces, cloth.uv), encoding="utf-8")
    for file, array in initial_state_files(cloth).items():
        np.save(part / file, array, allow_pickle=False)


def initial_state_files(cloth: ClothInfo) -> dict[str, np.ndarray]:
    """Return the arrays of the first frame by the name of their file."""
    arrays = {INITIAL_VERTICES_FILE: cloth.initial_vertices, INITIAL_VELOCITIES_FILE: cloth.initial_velocities}
    return {file: array for file, array in arrays.items() if array is not None}


def build_motion_arrays(recording: Recording) -> dict[str, Any]:
    """Build the arrays of motion.npz, a group per name.

    A gripper that is also an arm shares t, closed, force and torque with it.

    Raises:
        RecordingError: the shared arrays differ.
    """
    for name in recording.grippers.keys() & recording.joints.keys():
        gripper, arm = recording.grippers[name], recording.joints[name]
        for key in ("t", "closed", "force", "torque"):
            if not _same(getattr(gripper, key), getattr(arm, key)):
                what = f"grippers[{name!r}].{key} differs from joints[{name!r}].{key}"
                raise RecordingError(what, expected="the same, they are stored once", remedy="resample one of them")
    motions = [*recording.grippers.items(), *recording.joints.items()]
    return {f"{name}/{key}": value for name, motion in motions for key, value in bag_fields(motion).items()}


def _point_arrays(arrays: dict[str, Any], compact: bool) -> dict[str, Any]:
    xyz = np.asarray(arrays["xyz"])
    steps = np.round(xyz / POINT_SCALE_M)
    if compact and (np.abs(steps) <= np.iinfo(np.int16).max).all():  # False for NaN, which the reader then refuses
        return {**arrays, "xyz": steps.astype(np.int16), "scale": np.float64(POINT_SCALE_M)}
    return {**arrays, "xyz": xyz.astype(np.float32)}


def _write_images(folder: Path, camera: Camera, on_image: Callable[[], None]) -> None:
    streams_by_kind: dict[images.ImageKind, images.ImageStream]
    streams_by_kind = {kind: getattr(camera, kind) for kind in images.IMAGE_KINDS if getattr(camera, kind) is not None}
    if not streams_by_kind:
        return
    folder.mkdir()
    (folder / images.TIMESTAMPS_FILE).write_text(images.format_timestamps(streams_by_kind), encoding="utf-8")
    for kind, stream in streams_by_kind.items():
        (folder / kind).mkdir()
        for frame, suffix, data in stream.iterate_files():
            (folder / kind / f"{frame:06d}{suffix}").write_bytes(data)
            on_image()


def bag_fields(bag: Any, skip: tuple[str, ...] = ()) -> dict[str, Any]:
    """Return the fields of a data class that are not None, and its unknown extra keys."""
    return _with(bag.extra, **{f.name: getattr(bag, f.name) for f in fields(bag) if f.name not in (*skip, "extra")})


def _with(extra: dict[str, Any], /, **known: Any) -> dict[str, Any]:
    """Known values that are not None, then extra keys; an object that is in both is merged."""
    present = {key: value for key, value in known.items() if value is not None}
    merged = {
        key: _with(extra[key], **present[key])
        for key in present.keys() & extra.keys()
        if isinstance(present[key], dict)
    }
    return present | extra | present | merged


def _same(a: np.ndarray | None, b: np.ndarray | None) -> bool:
    return (a is None and b is None) or (a is not None and b is not None and np.array_equal(a, b))


def to_json_value(value: Any) -> Any:
    """Convert numpy values to JSON."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} cannot be stored as JSON")
