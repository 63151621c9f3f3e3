"""Writes an episode folder, and reads it back before it is put in its place."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InvalidInput, RecordingError
from ..meshes import obj
from . import checks, images, streams
from .atomic_write import place
from .consistency import check_recording
from .files import Folder, save_npz
from .reading import EPISODE, FORMAT, VERSION, read_folder
from .types import Camera, ClothInfo, GraspInfo, Recording

MESH, INITIAL = "cloth.obj", "cloth_initial.npy"
POINT_SCALE = 1e-4  # m; far below any sensor's noise


def write(
    recording: Recording,
    path: str | Path,
    *,
    overwrite: bool = False,
    compact: bool = True,
    on_image: Callable[[], None] = lambda: None,
) -> Path:
    """Write an episode folder atomically; what cannot be read back is refused.

    The final name only ever holds a whole episode. Overwriting moves the old folder aside first and brings it back
    when anything fails (after a power cut it lies beside as ``.NAME.*.old``). Files in it that the recording does
    not hold, such as truth that was not read, are lost.

    Args:
        recording: what to write.
        path: the episode folder.
        overwrite: replace an existing episode; a folder that is not an episode is never replaced.
        compact: store points in tenths of a millimetre (int16) where they fit, else as float32.
        on_image: called after each image, for a progress bar.

    Returns:
        The path of the episode.

    Raises:
        RecordingError: the target exists, or the recording would be refused by `read`, or the disk fails.
    """
    check_recording(recording)

    def fill(part: Path, shown: Path) -> None:
        _fill(part, recording, compact, on_image)
        read_folder(Folder(part, shown=shown), with_truth=True)

    return place(Path(path), fill, marker=EPISODE, overwrite=overwrite)


def _fill(part: Path, recording: Recording, compact: bool, on_image: Callable[[], None]) -> None:
    if recording.cloth is None:
        raise InvalidInput("recording.cloth", got="None", expected="a ClothInfo: what the cloth is")
    text = json.dumps(episode(recording), indent=1, allow_nan=False, default=plain)
    (part / EPISODE).write_text(text + "\n", encoding="utf-8")
    _write_cloth(part, recording.cloth)
    if motion := motion_arrays(recording):
        save_npz(part / streams.MOTION, motion)
    if recording.points is not None:
        save_npz(part / streams.POINTS, _point_arrays(held(recording.points), compact))
    if recording.markers is not None:
        save_npz(part / streams.MARKERS, held(recording.markers))
    if recording.truth is not None:
        save_npz(part / streams.TRUTH, held(recording.truth))
    for name, camera in recording.cameras.items():
        _write_images(part / checks.name(name, f"cameras[{name!r}]"), camera, on_image)


def episode(recording: Recording) -> dict[str, Any]:
    """The object of episode.json."""
    known = {
        "format": FORMAT,
        "version": VERSION,
        "cloth": _cloth(recording.cloth),
        "grasps": {name: _grasp(g) for name, g in recording.grasps.items()},
        "colliders": {
            name: _with(c.extra, plane={"point": c.point, "normal": c.normal}, friction=c.friction)
            for name, c in recording.colliders.items()
        },
        "robots": {name: held(r) for name, r in recording.robots.items()},
        "cameras": {name: held(c, skip=images.KINDS) for name, c in recording.cameras.items()},
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
        "mesh": None if cloth.vertices is None else MESH,
        "sheet": None if cloth.sheet is None else {"width": cloth.sheet[0], "height": cloth.sheet[1]},
        "initial_vertices": None if cloth.initial_vertices is None else INITIAL,
    }
    plain = ("areal_density", "areal_density_std", "thickness", "nominal")
    return _with(cloth.extra, **known, **{key: getattr(cloth, key) for key in plain})


def _grasp(grasp: GraspInfo) -> dict[str, Any]:
    return held(grasp, skip=("radius",) if grasp.uv is None else ())


def _write_cloth(part: Path, cloth: ClothInfo) -> None:
    if cloth.vertices is not None:
        if cloth.faces is None:
            raise RecordingError("cloth.faces is missing", expected="[F, 3] beside cloth.vertices")
        (part / MESH).write_text(obj.dump(cloth.vertices, cloth.faces, cloth.uv), encoding="utf-8")
    if cloth.initial_vertices is not None:
        np.save(part / INITIAL, cloth.initial_vertices, allow_pickle=False)


def motion_arrays(recording: Recording) -> dict[str, Any]:
    """Arrays of motion.npz, a group per name; a gripper that is also an arm shares t, closed, force and torque."""
    for name in recording.grippers.keys() & recording.joints.keys():
        gripper, arm = recording.grippers[name], recording.joints[name]
        for key in ("t", "closed", "force", "torque"):
            if not _same(getattr(gripper, key), getattr(arm, key)):
                what = f"grippers[{name!r}].{key} differs from joints[{name!r}].{key}"
                raise RecordingError(what, expected="the same, they are stored once", remedy="resample one of them")
    motions = [*recording.grippers.items(), *recording.joints.items()]
    return {f"{name}/{key}": value for name, motion in motions for key, value in held(motion).items()}


def _point_arrays(held: dict[str, Any], compact: bool) -> dict[str, Any]:
    xyz = np.asarray(held["xyz"])
    steps = np.round(xyz / POINT_SCALE)
    if compact and (np.abs(steps) <= np.iinfo(np.int16).max).all():  # False for NaN, which the reader then refuses
        return {**held, "xyz": steps.astype(np.int16), "scale": np.float64(POINT_SCALE)}
    return {**held, "xyz": xyz.astype(np.float32)}


def _write_images(folder: Path, camera: Camera, on_image: Callable[[], None]) -> None:
    every: dict[images.Kind, images.ImageStream]
    every = {kind: getattr(camera, kind) for kind in images.KINDS if getattr(camera, kind) is not None}
    if not every:
        return
    folder.mkdir()
    (folder / images.TIMESTAMPS).write_text(images.dump_times(every), encoding="utf-8")
    for kind, stream in every.items():
        (folder / kind).mkdir()
        for frame, suffix, data in stream.files():
            (folder / kind / f"{frame:06d}{suffix}").write_bytes(data)
            on_image()


def held(bag: Any, skip: tuple[str, ...] = ()) -> dict[str, Any]:
    """The fields of a bag that are not None, then its unknown extras."""
    return _with(bag.extra, **{f.name: getattr(bag, f.name) for f in fields(bag) if f.name not in (*skip, "extra")})


def _with(extra: dict[str, Any], /, **known: Any) -> dict[str, Any]:
    """What is known and not None, then what is extra; an object that is both (see `Fields.left`) is joined."""
    some = {key: value for key, value in known.items() if value is not None}
    joint = {key: _with(extra[key], **some[key]) for key in some.keys() & extra.keys() if isinstance(some[key], dict)}
    return some | extra | some | joint


def _same(a: np.ndarray | None, b: np.ndarray | None) -> bool:
    return (a is None and b is None) or (a is not None and b is not None and np.array_equal(a, b))


def plain(value: Any) -> Any:
    """JSON for what numpy holds."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} cannot be stored as JSON")
