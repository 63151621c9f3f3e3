"""Reader of one episode folder, with checks that its parts fit together."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from .._utils.constants import STANDARD_GRAVITY_M_PER_S2
from ..errors import RecordingError
from . import checks, images, scene, streams
from .checks import Fields
from .files import Folder
from .timing import MAX_FRAME_INTERVAL_S
from .types import Camera, GraspInfo, Recording

EPISODE_FILE = "episode.json"
EPISODE_FORMAT, EPISODE_VERSION = "torchcloth-recording", 1
EPISODE_SCHEMA = "torchcloth.episode/1"
RIZON_JOINT_COUNT = 7
MAX_GRAVITY_M_PER_S2 = 100.0  # above this it is in mm/s^2
MAX_AIR_DENSITY_KG_PER_M3 = 100.0  # above this it is in g/m^3, or water
MIN_TIMED_FRAMES = 5  # a stream of fewer frames has no reliable interval
MAX_SPAN_RATIO = 100.0  # of the durations of two streams in one unit
MARKER_UV_TOLERANCE = 0.01  # of the pattern's longer side; pattern coordinates of markers are measured by hand


def read(path: str | Path, *, with_truth: bool = False) -> Recording:
    """Read an episode, and refuse it if it cannot be trusted.

    Args:
        path: the episode folder.
        with_truth: also read truth.npz. Only for scoring: identification and diagnosis must never see it.

    Raises:
        RecordingError: names the file and key, what was there, what was expected and the remedy.
    """
    return read_folder(Folder(Path(path)), with_truth=with_truth)


def read_folder(folder: Folder, *, with_truth: bool) -> Recording:
    """Read an opened folder, see ``read``."""
    _check_is_episode(folder)
    checks.check_printable(folder.display_path.name, "name of the episode's folder")
    root = folder.read_json(EPISODE_FILE)
    _check_version(root)
    groups = streams.read_motion_groups(folder) if folder.has(streams.MOTION_FILE) else {}
    grippers, joints = streams.parse_motions(groups, folder.location(streams.MOTION_FILE))
    clouds = folder.read_npz(streams.POINTS_FILE) if folder.has(streams.POINTS_FILE) else None
    contents = {
        "grippers": grippers,
        "joints": joints,
        "points": None if clouds is None else streams.parse_points(clouds, folder.location(streams.POINTS_FILE)),
        "markers": streams.read_markers(folder) if folder.has(streams.MARKERS_FILE) else None,
        "truth": streams.read_truth(folder) if with_truth and folder.has(streams.TRUTH_FILE) else None,
        "path": folder.display_path,
    }
    return assemble_recording(
        root, folder, contents, lambda name, size: images.list_image_streams(folder.subfolder(name), size)
    )


def assemble_recording(
    root: Fields,
    folder: Folder,
    contents: dict[str, Any],
    images_of: Callable[[str, tuple[int, int]], dict[images.ImageKind, images.ImageStream]],
) -> Recording:
    """Assemble a recording from episode.json and its streams, and check that they fit.

    Args:
        root: the object in episode.json.
        folder: where the files lie that it names; for messages, where the episode lies.
        contents: the streams, by the names of ``Recording``.
        images_of: lists the images of a camera, given its name and (width, height).
    """
    gravity = _gravity(root)
    noise, air = root.group("observation_noise"), root.group("air")

    def camera(name: str, fields: Fields) -> Camera:
        return scene.read_camera(fields, lambda size: images_of(name, size))

    recording = Recording(
        cloth=scene.read_cloth(_require_group(root, "cloth"), folder),
        provenance=_provenance(root),
        grasps={name: scene.read_grasp(f) for name, f in root.named_groups("grasps").items()},
        robots={name: scene.read_robot(f) for name, f in root.named_groups("robots").items()},
        cameras={name: camera(name, f) for name, f in root.named_groups("cameras").items()},
        colliders={name: scene.read_collider(f) for name, f in root.named_groups("colliders").items()},
        observation_noise_std=noise.optional(noise.number, "std", minimum=0, maximum=1, suspect="millimetres"),
        clock_offset=root.optional(root.number, "clock_offset") or 0.0,
        gravity=np.array([0.0, 0.0, -STANDARD_GRAVITY_M_PER_S2]) if gravity is None else gravity,
        air_density=air.optional(air.number, "density", above=0, maximum=MAX_AIR_DENSITY_KG_PER_M3, suspect="g/m^3"),
        split=_split(root),
        licence=root.optional(root.text, "licence"),
        extra=root.unknown_keys(observation_noise=noise, air=air),
        **contents,
    )
    _check_cloth(recording, root.place)
    for name in recording.grasps:
        _check_grasp(recording, name, root.place, folder)
    _check_robots(recording, root.place, folder)
    _check_markers(recording, folder)
    _check_overlap(recording, folder)
    _check_seconds(recording, folder)
    return recording


def _gravity(root: Fields) -> np.ndarray | None:
    gravity = root.optional(root.array, "gravity", 3)
    if gravity is not None and np.linalg.norm(gravity) > MAX_GRAVITY_M_PER_S2:
        raise RecordingError(
            f"{root.location('gravity')} looks like mm/s^2",
            got=gravity.tolist(),
            expected=f"at most {MAX_GRAVITY_M_PER_S2:g} m/s^2 in length",
            remedy="use SI units",
        )
    return gravity


def _check_is_episode(folder: Folder) -> None:
    if not folder.has("."):
        raise RecordingError(
            f"{folder.display_path} does not exist", expected="an episode folder", remedy="check the path"
        )
    if not folder.path.is_dir():
        raise RecordingError(
            f"{folder.display_path} is a file",
            expected="an episode folder",
            remedy="pass the folder around it, or make one of another format with `torchcloth convert`",
        )
    if not folder.has(EPISODE_FILE):
        raise RecordingError(
            f"{folder.location(EPISODE_FILE)} is missing", expected="an episode folder", remedy="check the path"
        )


def _check_version(root: Fields) -> None:
    got = root.text("format")
    if got != EPISODE_FORMAT:
        raise RecordingError(
            f"{root.location('format')} is unknown",
            got=repr(got),
            expected=repr(EPISODE_FORMAT),
            remedy="convert it first",
        )
    schema = root.optional(root.text, "schema")
    if schema not in (None, EPISODE_SCHEMA):
        raise RecordingError(
            f"{root.location('schema')} is unknown",
            got=repr(schema),
            expected=repr(EPISODE_SCHEMA),
            remedy="update torchcloth",
        )
    version = root.number("version")
    if version != EPISODE_VERSION:
        raise RecordingError(
            f"{root.location('version')} is unknown",
            got=f"{version:g}",
            expected=f"{EPISODE_VERSION}",
            remedy="update torchcloth",
        )


def _require_group(root: Fields, key: str) -> Fields:
    return Fields(root.take(key), root.location(key))


def _provenance(root: Fields) -> str:
    got = root.text("provenance")
    if got != "measured" and not got.startswith("synthetic: "):
        expected = "'measured' or 'synthetic: <generator>'"
        raise RecordingError(
            f"{root.location('provenance')} is unclear", got=repr(got), expected=expected, remedy="say where it is from"
        )
    return got


def _split(root: Fields) -> dict:
    split = root.group("split")
    known = {key: split.optional(split.text, key) for key in ("motion", "replicate_of")}
    return {**{key: value for key, value in known.items() if value is not None}, **split.unknown_keys()}


def _check_cloth(recording: Recording, file: str) -> None:
    cloth, box = recording.cloth, recording.cloth.pattern_box()
    if cloth.sheet is None or cloth.uv is None or box is None:
        return
    got = box[1] - box[0]
    if not np.allclose(got, cloth.sheet, rtol=0.01):
        expected = f"{list(cloth.sheet)}"
        raise RecordingError(
            f"{file}: cloth.sheet is not the mesh",
            got=f"a mesh of {got.tolist()}",
            expected=expected,
            remedy="drop one",
        )


def _check_grasp(recording: Recording, name: str, file: str, folder: Folder) -> None:
    """A grasp needs a gripper that moves and material to hold; ``file`` is the file that names it."""
    place = f"{file}: grasps.{name}"
    if name not in recording.grippers and name not in recording.joints:
        got = sorted({*recording.grippers, *recording.joints})
        raise RecordingError(
            f"{place} has no motion",
            got=got,
            expected=f"{name}/t in {streams.MOTION_FILE}",
            remedy="rename or record it, or leave the grasp out; in a scene, say in source what moves it",
        )
    arm = recording.joints.get(name)
    if arm is not None and arm.closed is None and arm.width is None:
        raise RecordingError(
            f"{folder.location(streams.MOTION_FILE)}: {name}/closed is missing", expected="closed or width [K]"
        )
    grasp = recording.grasps[name]
    if grasp.uv is None:
        _check_grasped_vertices(recording, grasp, place)
    else:
        _check_grasped_pattern(recording, grasp.uv, grasp.radius, place)


def _check_grasped_vertices(recording: Recording, grasp: GraspInfo, place: str) -> None:
    mesh, vertices = recording.cloth.vertices, grasp.vertices
    if mesh is None or vertices is None:
        raise RecordingError(f"{place} has no vertices to hold", expected="cloth.mesh, and vertices or uv")
    if not len(vertices) or vertices.min() < 0 or vertices.max() >= len(mesh):
        got, expected = f"vertices {vertices.tolist()}", f"indices in 0 to {len(mesh) - 1}"
        raise RecordingError(f"{place} holds nothing", got=got, expected=expected, remedy="count vertices from 0")


def _check_grasped_pattern(recording: Recording, uv: np.ndarray, radius: float, place: str) -> None:
    box = recording.cloth.pattern_box()
    if box is None:
        raise RecordingError(
            f"{place} cannot be found on the mesh", expected="vt in the mesh file", remedy="export with uv"
        )
    outside = np.linalg.norm(np.maximum(np.maximum(box[0] - uv, uv - box[1]), 0), axis=1)
    if outside.max() > radius:
        got = f"uv {uv[int(outside.argmax())].tolist()}, {outside.max():.3g} m outside"
        expected = f"within {box[0].tolist()} to {box[1].tolist()}"
        raise RecordingError(
            f"{place} holds nothing", got=got, expected=expected, remedy="use pattern coordinates in metres"
        )
    if recording.cloth.uv is not None:
        points = recording.cloth.uv.reshape(-1, 2)
        nearest = min(float(np.linalg.norm(points - point, axis=1).min()) for point in uv)
        if nearest > radius:
            got = f"radius {radius:g}, nearest vertex at {nearest:.3g} m"
            raise RecordingError(
                f"{place} holds no vertex", got=got, expected="one vertex within", remedy="refine the mesh"
            )


def _check_robots(recording: Recording, file: str, folder: Folder) -> None:
    for name, robot in recording.robots.items():
        if name not in recording.joints and name not in recording.grippers:
            got = sorted({*recording.grippers, *recording.joints})
            raise RecordingError(f"{file}: robots.{name} is an unknown arm", got=got, expected="a name in motion.npz")
        arm = recording.joints.get(name)
        if (
            arm is not None
            and robot.model.startswith("rizon")
            and not robot.model.endswith(".urdf")
            and arm.q.shape[1] != RIZON_JOINT_COUNT
        ):
            place = f"{folder.location(streams.MOTION_FILE)}: {name}/q"
            raise RecordingError(
                f"{place} is not a {robot.model}'s", got=list(arm.q.shape), expected=f"[K, {RIZON_JOINT_COUNT}]"
            )


def _check_markers(recording: Recording, folder: Folder) -> None:
    box = recording.cloth.pattern_box()
    if recording.markers is None or recording.markers.uv is None or box is None:
        return
    uv, slack = recording.markers.uv, MARKER_UV_TOLERANCE * float((box[1] - box[0]).max())
    outside = ((uv < box[0] - slack) | (uv > box[1] + slack)).any(axis=1)
    if outside.any():
        got = uv[outside][0].tolist()
        expected = f"within {box[0].tolist()} to {box[1].tolist()}"
        raise RecordingError(
            f"{folder.location(streams.MARKERS_FILE)}: uv is not on the cloth", got=got, expected=expected
        )


def _check_overlap(recording: Recording, folder: Folder) -> None:
    """Observations and motion must share some time, on the motion clock."""
    offset = recording.clock_offset
    seen = {streams.POINTS_FILE: recording.points, streams.MARKERS_FILE: recording.markers}
    spans = [(folder.location(file), s.t[0] + offset, s.t[-1] + offset) for file, s in seen.items() if s is not None]
    if recording.truth is not None:
        spans.append((folder.location(streams.TRUTH_FILE), recording.truth.t[0], recording.truth.t[-1]))
        if recording.provenance == "measured":
            raise RecordingError(
                f"{folder.location(streams.TRUTH_FILE)} is in a measured episode", expected="a synthetic one"
            )
    times = [m.t for m in (*recording.grippers.values(), *recording.joints.values())]
    if not times:
        return
    first, last = min(t[0] for t in times), max(t[-1] for t in times)
    for place, start, end in spans:
        if start > last or end < first:
            got = f"{start:.6g} to {end:.6g} s"
            expected = f"some of {first:.6g} to {last:.6g} s"
            raise RecordingError(
                f"{place}: t does not overlap the motion", got=got, expected=expected, remedy="set clock_offset"
            )


def _check_seconds(recording: Recording, folder: Folder) -> None:
    """Refuse streams that are obviously in milliseconds.

    Streams of one motion last about as long: if one has longer intervals than another lasts, it is in another unit. So
    are all of them if the cloth was seen more rarely than by any camera.
    """
    motions = {**recording.grippers, **recording.joints}
    times = {f"{folder.location(streams.MOTION_FILE)}: {name}/t": motion.t for name, motion in motions.items()}
    seen = {streams.POINTS_FILE: recording.points, streams.MARKERS_FILE: recording.markers}
    times |= {f"{folder.location(file)}: t": stream.t for file, stream in seen.items() if stream is not None}
    spans = {place: float(t[-1] - t[0]) for place, t in times.items() if len(t) > 1}
    for file, stream in seen.items():
        step = 0.0 if stream is None or len(stream.t) < MIN_TIMED_FRAMES else float(np.median(np.diff(stream.t)))
        if step > MAX_FRAME_INTERVAL_S:
            place, got = f"{folder.location(file)}: t", f"steps of {step:.4g}"
            raise RecordingError(f"{place} looks like milliseconds", got=got, expected="seconds", remedy="rescale it")
    long_spans = {place: span for place, span in spans.items() if len(times[place]) >= MIN_TIMED_FRAMES}
    shortest = min(long_spans, key=long_spans.__getitem__, default="")
    for place, span in spans.items():
        step = float(np.median(np.diff(times[place])))
        if len(times[place]) >= MIN_TIMED_FRAMES and span > MAX_SPAN_RATIO * spans[shortest] and step > spans[shortest]:
            raise RecordingError(
                f"{place} looks like milliseconds",
                got=f"steps of {step:.4g}, while {shortest} spans {spans[shortest]:.4g}",
                expected="seconds",
                remedy="rescale it",
            )
