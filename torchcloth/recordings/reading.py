"""Reads one episode folder and checks that its parts fit together."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import RecordingError
from . import images, scene, streams
from .checks import Fields
from .files import Folder
from .timing import SLOWEST
from .types import Camera, GraspInfo, Recording

EPISODE = "episode.json"
FORMAT, VERSION = "torchcloth-recording", 1
RIZON_JOINTS = 7
STRONGEST_GRAVITY = 100.0  # m/s^2; above this it is in mm/s^2
DENSEST_AIR = 100.0  # kg/m^3; above this it is in g/m^3, or water
FEW_TICKS, FAR_LONGER = 5, 100.0  # of a stream, before its spacing says something; spans in one unit differ by less
MARKER_SLACK = 0.01  # of the pattern's longer side: a marker's pattern coordinates are measured by hand


def read(path: str | Path, *, with_truth: bool = False) -> Recording:
    """Read an episode and refuse it when it cannot be trusted.

    Args:
        path: the episode folder.
        with_truth: also read truth.npz. Only for scoring: identify and diagnose must never see it.

    Raises:
        RecordingError: names the file and key, what was found, what was expected and the remedy.
    """
    return read_folder(Folder(Path(path)), with_truth=with_truth)


def read_folder(folder: Folder, *, with_truth: bool) -> Recording:
    """Read an opened folder, see `read`."""
    _refuse_no_episode(folder)
    root = folder.json(EPISODE)
    _check_version(root)
    groups = streams.groups(folder) if folder.has(streams.MOTION) else {}
    grippers, joints = streams.motions(groups, folder.place(streams.MOTION))
    clouds = folder.npz(streams.POINTS) if folder.has(streams.POINTS) else None
    held = {
        "grippers": grippers,
        "joints": joints,
        "points": None if clouds is None else streams.points(clouds, folder.place(streams.POINTS)),
        "markers": streams.markers(folder) if folder.has(streams.MARKERS) else None,
        "truth": streams.truth(folder) if with_truth and folder.has(streams.TRUTH) else None,
        "path": folder.shown,
    }
    return assemble(root, folder, held, lambda name, size: images.find_streams(folder.sub(name), size))


def assemble(
    root: Fields,
    folder: Folder,
    held: dict[str, Any],
    images_of: Callable[[str, tuple[int, int]], dict[images.Kind, images.ImageStream]],
) -> Recording:
    """Put what episode.json says together with the streams, and check that they fit.

    Args:
        root: the object in episode.json.
        folder: where the files lie that it names; for messages, where the episode lies.
        held: the streams, by the names of `Recording`.
        images_of: finds the images of a camera by its name and (width, height).
    """
    gravity = _gravity(root)
    noise, air = root.inside("observation_noise"), root.inside("air")

    def camera(name: str, fields: Fields) -> Camera:
        return scene.camera(fields, lambda size: images_of(name, size))

    recording = Recording(
        cloth=scene.cloth(_needed(root, "cloth"), folder),
        provenance=_provenance(root),
        grasps={name: scene.grasp(f) for name, f in root.each("grasps").items()},
        robots={name: scene.robot(f) for name, f in root.each("robots").items()},
        cameras={name: camera(name, f) for name, f in root.each("cameras").items()},
        colliders={name: scene.collider(f) for name, f in root.each("colliders").items()},
        observation_noise_std=noise.maybe(noise.number, "std", least=0, most=1, suspect="millimetres"),
        clock_offset=root.maybe(root.number, "clock_offset") or 0.0,
        gravity=np.array([0.0, 0.0, -9.81]) if gravity is None else gravity,
        air_density=air.maybe(air.number, "density", above=0, most=DENSEST_AIR, suspect="g/m^3"),
        split=_split(root),
        licence=root.maybe(root.text, "licence"),
        extra=root.left(observation_noise=noise, air=air),
        **held,
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
    gravity = root.maybe(root.array, "gravity", 3)
    if gravity is not None and np.linalg.norm(gravity) > STRONGEST_GRAVITY:
        raise RecordingError(
            f"{root.at('gravity')} looks like mm/s^2",
            got=gravity.tolist(),
            expected=f"at most {STRONGEST_GRAVITY:g} m/s^2 in length",
            remedy="use SI units",
        )
    return gravity


def _refuse_no_episode(folder: Folder) -> None:
    if not folder.has("."):
        raise RecordingError(f"{folder.shown} does not exist", expected="an episode folder", remedy="check the path")
    if not folder.path.is_dir():
        raise RecordingError(
            f"{folder.shown} is a file",
            expected="an episode folder",
            remedy="pass the folder around it, or make one of another format with `torchcloth convert`",
        )
    if not folder.has(EPISODE):
        raise RecordingError(
            f"{folder.place(EPISODE)} is missing", expected="an episode folder", remedy="check the path"
        )


def _check_version(root: Fields) -> None:
    got = root.text("format")
    if got != FORMAT:
        raise RecordingError(
            f"{root.at('format')} is unknown", got=repr(got), expected=repr(FORMAT), remedy="convert it first"
        )
    version = root.number("version")
    if version != VERSION:
        raise RecordingError(
            f"{root.at('version')} is unknown", got=f"{version:g}", expected=f"{VERSION}", remedy="update torchcloth"
        )


def _needed(root: Fields, key: str) -> Fields:
    return Fields(root.take(key), root.at(key))


def _provenance(root: Fields) -> str:
    got = root.text("provenance")
    if got != "measured" and not got.startswith("synthetic: "):
        expected = "'measured' or 'synthetic: <generator>'"
        raise RecordingError(
            f"{root.at('provenance')} is unclear", got=repr(got), expected=expected, remedy="say where it is from"
        )
    return got


def _split(root: Fields) -> dict:
    split = root.inside("split")
    known = {key: split.maybe(split.text, key) for key in ("motion", "replicate_of")}
    return {**{key: value for key, value in known.items() if value is not None}, **split.left()}


def _check_cloth(recording: Recording, told: str) -> None:
    cloth, box = recording.cloth, recording.cloth.pattern_box()
    if cloth.sheet is None or cloth.uv is None or box is None:
        return
    got = box[1] - box[0]
    if not np.allclose(got, cloth.sheet, rtol=0.01):
        expected = f"{list(cloth.sheet)}"
        raise RecordingError(
            f"{told}: cloth.sheet is not the mesh",
            got=f"a mesh of {got.tolist()}",
            expected=expected,
            remedy="drop one",
        )


def _check_grasp(recording: Recording, name: str, told: str, folder: Folder) -> None:
    """A grasp needs a gripper that moves and material to hold; ``told`` is the file that names it."""
    place = f"{told}: grasps.{name}"
    if name not in recording.grippers and name not in recording.joints:
        got = sorted({*recording.grippers, *recording.joints})
        raise RecordingError(
            f"{place} has no motion",
            got=got,
            expected=f"{name}/t in {streams.MOTION}",
            remedy="rename or record it, or leave the grasp out; in a scene, say in source what moves it",
        )
    arm = recording.joints.get(name)
    if arm is not None and arm.closed is None and arm.width is None:
        raise RecordingError(
            f"{folder.place(streams.MOTION)}: {name}/closed is missing", expected="closed or width [K]"
        )
    grasp = recording.grasps[name]
    if grasp.uv is None:
        _check_held_vertices(recording, grasp, place)
    else:
        _check_held_pattern(recording, grasp.uv, grasp.radius, place)


def _check_held_vertices(recording: Recording, grasp: GraspInfo, place: str) -> None:
    mesh, held = recording.cloth.vertices, grasp.vertices
    if mesh is None or held is None:
        raise RecordingError(f"{place} has no vertices to hold", expected="cloth.mesh, and vertices or uv")
    if not len(held) or held.min() < 0 or held.max() >= len(mesh):
        got, expected = f"vertices {held.tolist()}", f"indices in 0 to {len(mesh) - 1}"
        raise RecordingError(f"{place} holds nothing", got=got, expected=expected, remedy="count vertices from 0")


def _check_held_pattern(recording: Recording, uv: np.ndarray, radius: float, place: str) -> None:
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


def _check_robots(recording: Recording, told: str, folder: Folder) -> None:
    for name, robot in recording.robots.items():
        if name not in recording.joints and name not in recording.grippers:
            got = sorted({*recording.grippers, *recording.joints})
            raise RecordingError(f"{told}: robots.{name} is an unknown arm", got=got, expected="a name in motion.npz")
        arm = recording.joints.get(name)
        if (
            arm is not None
            and robot.model.startswith("rizon")
            and not robot.model.endswith(".urdf")
            and arm.q.shape[1] != RIZON_JOINTS
        ):
            place = f"{folder.place(streams.MOTION)}: {name}/q"
            raise RecordingError(
                f"{place} is not a {robot.model}'s", got=list(arm.q.shape), expected=f"[K, {RIZON_JOINTS}]"
            )


def _check_markers(recording: Recording, folder: Folder) -> None:
    box = recording.cloth.pattern_box()
    if recording.markers is None or recording.markers.uv is None or box is None:
        return
    uv, slack = recording.markers.uv, MARKER_SLACK * float((box[1] - box[0]).max())
    outside = ((uv < box[0] - slack) | (uv > box[1] + slack)).any(axis=1)
    if outside.any():
        got = uv[outside][0].tolist()
        expected = f"within {box[0].tolist()} to {box[1].tolist()}"
        raise RecordingError(f"{folder.place(streams.MARKERS)}: uv is not on the cloth", got=got, expected=expected)


def _check_overlap(recording: Recording, folder: Folder) -> None:
    """What was seen and what moved must share some time, on the motion clock."""
    offset = recording.clock_offset
    seen = {streams.POINTS: recording.points, streams.MARKERS: recording.markers}
    spans = [(folder.place(file), s.t[0] + offset, s.t[-1] + offset) for file, s in seen.items() if s is not None]
    if recording.truth is not None:
        spans.append((folder.place(streams.TRUTH), recording.truth.t[0], recording.truth.t[-1]))
        if recording.provenance == "measured":
            raise RecordingError(f"{folder.place(streams.TRUTH)} is in a measured episode", expected="a synthetic one")
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
    """Streams of one motion last about as long: one that ticks more slowly than another lasts is in another unit.

    So are all of them where the cloth was seen more slowly than any camera sees.
    """
    motions = {**recording.grippers, **recording.joints}
    times = {f"{folder.place(streams.MOTION)}: {name}/t": motion.t for name, motion in motions.items()}
    seen = {streams.POINTS: recording.points, streams.MARKERS: recording.markers}
    times |= {f"{folder.place(file)}: t": stream.t for file, stream in seen.items() if stream is not None}
    spans = {place: float(t[-1] - t[0]) for place, t in times.items() if len(t) > 1}
    for file, stream in seen.items():
        step = 0.0 if stream is None or len(stream.t) < FEW_TICKS else float(np.median(np.diff(stream.t)))
        if step > SLOWEST:
            place, got = f"{folder.place(file)}: t", f"steps of {step:.4g}"
            raise RecordingError(f"{place} looks like milliseconds", got=got, expected="seconds", remedy="rescale it")
    lasting = {place: span for place, span in spans.items() if len(times[place]) >= FEW_TICKS}
    brief = min(lasting, key=lasting.__getitem__, default="")
    for place, span in spans.items():
        step = float(np.median(np.diff(times[place])))
        if len(times[place]) >= FEW_TICKS and span > FAR_LONGER * spans[brief] and step > spans[brief]:
            raise RecordingError(
                f"{place} looks like milliseconds",
                got=f"steps of {step:.4g}, while {brief} spans {spans[brief]:.4g}",
                expected="seconds",
                remedy="rescale it",
            )
