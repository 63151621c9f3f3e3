"""One capture of RGBench, simulated in the "fixed point" protocol, and its distances from the clouds.

In a fold or grasp the garment lies flat on the ground until the window begins; each gripper then holds the vertices
nearest to it. In a fling it hangs from its shoulders. Layers do not touch each other, as in the benchmark's MuJoCo. The
published meshes are simulated, because distances to vertices depend on their density.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchcloth.cloth import Cloth
from torchcloth.episodes.replay import Replay
from torchcloth.errors import InvalidInput, TorchclothError
from torchcloth.identification import build_cloth, build_episode, carry_rigidly, identify
from torchcloth.losses import chamfer_to_surface, chamfer_to_vertices
from torchcloth.recordings import ClothInfo, Collider, GraspInfo, GripperMotion, PointClouds, Recording, streams
from torchcloth.recordings.formats.rgbench import RGBENCH_IMPORTER
from torchcloth.recordings.formats.scene_file import SceneFile
from torchcloth.robots import replay  # pyright: ignore[reportMissingImports] - mapped from robots/

from .rgbench_data import Capture, Garment, read_garment

FITTED_NAMES = ["youngs_modulus", "bending.stiffness", "air.normal"]
AIR_DENSITY_KG_PER_M3 = 1.2
CLOUD_NOISE_M = 3e-3  # of the benchmark's stereo camera at a metre
PINNED_RADIUS_M = 0.012
GROUND_GAP_M = 1e-3  # of the lowest vertex above the ground at first
DEFAULT_PLACE_M = (0.1, 0.0)  # where the benchmark lays a garment
ALIGNMENT_ITERATIONS = 40
MAX_ALIGNED_POINTS = 2000
START_ANGLES_RAD = (-0.3, -0.15, 0.0, 0.15, 0.3)  # about the vertical
LIFT_S, HANG_S = 1.0, 3.0  # before a fling
MIN_CLOUDS = 3
FAST_CLOUDS, FAST_WINDOW_S, FAST_HANG_S = 6, 1.0, 1.0


@dataclass(frozen=True)
class RgbenchSettings:
    """What a case depends on besides the data.

    Attributes:
        iterations: of a fit, at most.
        fast: whether only the beginning of the window counts, with a few clouds.
    """

    iterations: int
    fast: bool


def simulate_capture(
    data: Path, configs: Path, capture: Capture, settings: RgbenchSettings, values: Mapping[str, float]
) -> dict[str, Any]:
    """Simulate a capture with given values of the fabric; return its mean distances [m], or why there are none."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            recording = prepare_capture(read_garment(capture.garment, data, configs), capture, settings)
            distances = compute_distances(recording, values)
        except TorchclothError as error:
            return {"failed": str(error)}
    return {**distances, "warnings": sorted({str(warning.message) for warning in caught})}


def fit_capture(data: Path, configs: Path, capture: Capture, settings: RgbenchSettings) -> dict[str, Any]:
    """Fit the fabric to a capture; return the identifiable values by module path."""
    try:
        recording = prepare_capture(read_garment(capture.garment, data, configs), capture, settings)
        fit = identify(build_cloth(recording), recording, FITTED_NAMES, iterations=settings.iterations)
    except TorchclothError as error:
        return {"values": {}, "identified": [], "failed": str(error)}
    names = [name for name in fit.keys if fit.parameters[name].identifiable]
    estimates = {name: fit.parameters[name].__dict__ for name in fit.keys}
    return {
        "values": {fit.keys[name]: fit.parameters[name].value for name in names},
        "identified": names,
        "estimates": {name: {key: e[key] for key in ("value", "std", "identifiable")} for name, e in estimates.items()},
        "warnings": fit.warnings,
    }


def prepare_capture(garment: Garment, capture: Capture, settings: RgbenchSettings) -> Recording:
    """Return the recording of a capture's window, with the first shape and the grips of the garment.

    Raises:
        RecordingError: the capture is damaged.
        InvalidInput: the window holds no clouds, or the mesh cannot be simulated.
    """
    imported = RGBENCH_IMPORTER.read(capture.folder, SceneFile.read(None), None)
    grippers, _ = streams.parse_motions(imported.motion, str(capture.folder))
    points = _select_window(streams.parse_points(imported.points or {}, str(capture.folder)), capture, settings)
    start = float(points.t[0])
    hands = {name: _positions_at(motion, start) for name, motion in grippers.items()}
    recording = Recording(
        cloth=ClothInfo(
            areal_density=garment.areal_density,
            vertices=garment.vertices,
            faces=garment.faces,
            nominal=dict(garment.nominal),
        ),
        provenance="measured",
        grippers={name: _start_at(motion, start) for name, motion in grippers.items()},
        colliders={"ground": Collider(np.zeros(3), np.array([0.0, 0.0, 1.0]), garment.ground_friction)},
        points=points,
        observation_noise_std=CLOUD_NOISE_M,
        air_density=AIR_DENSITY_KG_PER_M3,
        path=capture.folder,
    )
    if capture.action == "fling":
        grips = _shoulder_grips(garment, list(hands))
        return hang(recording, {name: _near(garment.vertices, grip) for name, grip in grips.items()}, hands, settings)
    rotation, shift = lay_down(garment.vertices, points.frame(0))
    laid = garment.vertices @ rotation.T + shift
    return replace(
        recording,
        cloth=replace(recording.cloth, initial_vertices=laid),
        grasps={name: GraspInfo(vertices=_near(laid, _nearest(laid, hand))) for name, hand in hands.items()},
    )


def compute_distances(recording: Recording, values: Mapping[str, float]) -> dict[str, Any]:
    """Simulate a prepared capture; return distances from its clouds, as means [m] over the frames."""
    cloth = build_cloth(recording)
    for path, value in values.items():
        cloth.get_submodule(path).set(value)  # type: ignore[operator]
    episode, faces = build_episode(cloth, recording), torch.as_tensor(cloth.mesh.faces)
    with torch.no_grad():
        frames = {"simulated": Replay(cloth)(episode).x, "carried": carry_rigidly(episode)}
    out: dict[str, Any] = {"frames": len(episode.clouds), "triangles": len(faces)}
    for name, x in frames.items():
        rows = [
            (chamfer_to_vertices(cloud, v, norm=1), chamfer_to_vertices(cloud, v), chamfer_to_surface(cloud, v, faces))
            for cloud, v in zip(episode.clouds, x, strict=True)
        ]
        means = torch.tensor(rows).mean(0).tolist()
        out[name] = dict(zip(("vertices_l1", "vertices_l2", "surface"), means, strict=True))
    return out


def lay_down(vertices: np.ndarray, cloud: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rotation [3, 3] and shift [3] m that lay a flat garment on the ground under the first cloud.

    The garment turns about the vertical only (iterated closest points). Searches begin where the benchmark lays it and
    with its centre under the cloud's, turned by some angles; the nearest end is taken.
    """
    from scipy.spatial import KDTree
    from scipy.spatial.transform import Rotation

    sample = cloud[:: max(1, len(cloud) // MAX_ALIGNED_POINTS)]
    middle, tree = (vertices.min(0) + vertices.max(0)) / 2, KDTree(vertices)
    height = GROUND_GAP_M - vertices[:, 2].min()
    results = []
    for xy, angle in product((middle[:2] + DEFAULT_PLACE_M, sample.mean(0)[:2]), START_ANGLES_RAD):
        rotation = Rotation.from_euler("z", angle).as_matrix()
        shift = np.array([*(xy - rotation[:2, :2] @ middle[:2]), height])
        distance = np.inf
        for _ in range(ALIGNMENT_ITERATIONS):
            distances, nearest = tree.query((sample - shift) @ rotation)
            source, target = vertices[nearest, :2], sample[:, :2]
            left, _, right = np.linalg.svd((target - target.mean(0)).T @ (source - source.mean(0)))
            rotation[:2, :2] = left @ np.diag([1.0, np.linalg.det(left @ right)]) @ right
            shift[:2] = target.mean(0) - rotation[:2, :2] @ source.mean(0)
            distance = float(distances.mean())
        results.append((distance, rotation, shift))
    return min(results, key=lambda result: result[0])[1:]


def hang(
    recording: Recording,
    grips: Mapping[str, np.ndarray],
    hands: Mapping[str, np.ndarray],
    settings: RgbenchSettings,
) -> Recording:
    """Return the recording with the shape of the garment that hangs from two grips, which the grippers hold.

    Args:
        recording: of the window, with the flat mesh.
        grips: vertices of the mesh by gripper.
        hands: [3] m, positions of the grippers when the window begins.
        settings: of the study.
    """
    mesh = np.asarray(recording.cloth.vertices)
    places = {name: mesh[vertices].mean(0) for name, vertices in grips.items()}
    placed = _upright(mesh, list(places.values()), list(hands.values()))
    duration = LIFT_S + (FAST_HANG_S if settings.fast else HANG_S)
    t = np.linspace(0.0, duration, 1 + round(50 * duration))
    share = 0.5 * (1 - np.cos(np.pi * np.clip(t / LIFT_S, 0.0, 1.0)))[:, None]
    lifts = {}
    for name, vertices in grips.items():
        begin, facing = placed[vertices].mean(0), recording.grippers[name].quat_wxyz[0]
        path = begin + share * (hands[name] - begin)
        lifts[name] = GripperMotion(t, path, np.tile(facing, (len(t), 1)), np.ones(len(t), dtype=bool))
    gripped = replace(
        recording, grasps={name: GraspInfo(vertices=vertices) for name, vertices in grips.items()}, colliders={}
    )
    cloth: Cloth = build_cloth(gripped)
    with torch.no_grad():
        state = cloth.state(torch.as_tensor(placed))
        x = cloth(state, replay(replace(gripped, grippers=lifts)), [0.0, duration]).x[-1]
    return replace(
        gripped, cloth=replace(recording.cloth, initial_vertices=x.numpy()), colliders=dict(recording.colliders)
    )


def _upright(mesh: np.ndarray, places: Sequence[np.ndarray], hands: Sequence[np.ndarray]) -> np.ndarray:
    """Return the vertices of a flat mesh, turned so that it hangs below its grips, which face the hands."""
    if len(places) != 2:
        raise InvalidInput("fling", got=f"{len(places)} grippers", expected="2 grippers")

    def axes(across: np.ndarray, down: np.ndarray) -> np.ndarray:
        across = across / np.linalg.norm(across)
        down = down - (down @ across) * across
        down = down / np.linalg.norm(down)
        return np.stack([across, down, np.cross(across, down)], axis=-1)

    grip, hand = np.mean(places, axis=0), np.mean(hands, axis=0)
    before = axes(places[1] - places[0], mesh.mean(0) - grip)
    after = axes(hands[1] - hands[0], np.array([0.0, 0.0, -1.0]))
    return (mesh - grip) @ (after @ before.T).T + hand


def _shoulder_grips(garment: Garment, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Return the places [3] m on the flat garment that each gripper holds in a fling."""
    if len(garment.shoulders) != 2:
        raise InvalidInput("shoulder_index", got=list(garment.shoulders), expected="two vertices, left and right")
    left, right = garment.shoulders
    return {name: garment.vertices[left if name == "left" else right] for name in names}


def _nearest(vertices: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Return the vertex [3] m that is nearest to a place."""
    return vertices[np.linalg.norm(vertices - place, axis=1).argmin()]


def _near(vertices: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Return the vertices within the radius of a grip; the nearest one if there are none."""
    distance = np.linalg.norm(vertices - place, axis=1)
    return np.flatnonzero(distance <= max(PINNED_RADIUS_M, distance.min()))


def _select_window(points: PointClouds, capture: Capture, settings: RgbenchSettings) -> PointClouds:
    end = min(capture.end, capture.start + FAST_WINDOW_S) if settings.fast else capture.end
    frames = np.flatnonzero((points.t >= capture.start) & (points.t <= end))
    if len(frames) < MIN_CLOUDS:
        got = f"{len(frames)} clouds from {capture.start:g} to {end:g} s"
        expected = f"at least {MIN_CLOUDS}; the clouds are from {points.t[0]:.3g} to {points.t[-1]:.3g} s"
        raise InvalidInput(str(capture.folder), got=got, expected=expected)
    return points.select(frames[:: max(1, len(frames) // FAST_CLOUDS)] if settings.fast else frames)


def _positions_at(motion: GripperMotion, time: float) -> np.ndarray:
    return np.array([np.interp(time, motion.t, coordinate) for coordinate in motion.position.T])


def _start_at(motion: GripperMotion, start: float) -> GripperMotion:
    """Return the motion from the last sample before ``start`` [s] on."""
    first = max(0, int(np.searchsorted(motion.t, start, side="right")) - 1)
    return GripperMotion(
        motion.t[first:], motion.position[first:], motion.quat_wxyz[first:], np.ones(len(motion.t) - first, dtype=bool)
    )
