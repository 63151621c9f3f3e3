"""Pose from a network: clouds of another engine that begin in mid-motion, cut out without knowing the truth.

MuJoCo moves sheets of 0.3 to 0.5 m by two corners, an edge or a corner; a Kinect or a RealSense sees them, with arms in
view and about 30 % hidden. A recording has no first shape, and the cloth moves at its first frame. Compared are the
network, frame by frame; registration of each frame; the simulation from rest; and the network with the simulation.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

import torchcloth as tc
from torchcloth import identification, recordings
from torchcloth._utils.constants import Z_95
from torchcloth._utils.files import to_json, write_atomically, write_text
from torchcloth.boundaries import Grasp
from torchcloth.boundaries.motion import interpolate_poses
from torchcloth.effects import AirDrag
from torchcloth.episodes.replay import Replay
from torchcloth.errors import InvalidInput, SimulationDiverged, TorchclothError
from torchcloth.identification import Episode
from torchcloth.losses import chamfer_to_surface
from torchcloth.pose import PoseEstimator, estimate_pose, load_network, rest_coordinates
from torchcloth.pose.first_shape import SHIPPED_NETWORK, pose_inputs
from torchcloth.pose.network_answers import MIN_POINTS_FOR_NETWORK
from torchcloth.pose.scene_frame import build_scene_frame
from torchcloth.pose.visibility import find_seen_vertices
from torchcloth.recordings import Recording

from ..resumable import ResumableStudy, write_result
from ..validation.independent.flex_sheet import SheetSpec, interpolate_bilinear
from ..validation.independent.moving_recording import MovingRecording, MovingSize, make_moving_recording
from .geometric_baselines import register_frames
from .pose_network_tables import print_tables, to_markdown, write_picture

EPISODE_COUNT, FAST_EPISODE_COUNT = 16, 1
FAST_SIZE = MovingSize(spacing=0.05, fit=7, rate=10.0, shrink=2)
REGISTERED, SIMULATED, TRUE_START = "registered", "simulated", ("true shape at rest", "true shape in motion")
ALONE, WITH_PREVIOUS, WITH_SIMULATION = "network", "network, frame before", "network + simulation"
REGISTRATION_NOISE_STD_M = 4e-3  # that registration counts with
FORCE_MODES, FAST_FORCE_MODES = 6, 3
FORCE_WINDOW_S = 0.25
STIFFNESS_FACTOR, DRAG_STD_FRACTION = 2.0, 0.5  # how uncertain the nominal fabric is
START_BULGE_M = 2e-3  # of the flat sheet that settles: a plane is a bifurcation
SETTLE_S, SETTLE_RATE_PER_S = 1.5, 10.0
HEADING_COUNT = 24  # that are tried for a sheet in a single gripper
MANY_HIDDEN = 0.3  # share of the vertices
WARM_UP_CALLS = 3


class HeldOut(NamedTuple):
    """An episode that no network was trained with.

    Attributes:
        recording: without a first shape.
        cloth: of it.
        x: [T, V, 3] m, the truth at the cloth's vertices.
        v: [T, V, 3] m/s.
        facts: grip, motion, camera, shares of what is hidden.
    """

    recording: Recording
    cloth: tc.Cloth
    x: Tensor
    v: Tensor
    facts: dict[str, Any]


def add(parser: argparse.ArgumentParser) -> None:
    """Add the study's options."""
    parser.add_argument("--episodes", type=int, metavar="N", help=f"({EPISODE_COUNT}; more can be added later)")
    parser.add_argument("--first", type=int, default=0, metavar="SEED", help="seed of the first episode (0)")
    parser.add_argument(
        "--network", action="append", metavar="NAME=FILE", help="weights to compare, more than once (the shipped ones)"
    )
    parser.add_argument("--true-start", action="store_true", help="the smoother from the true first shape, too")


def run(options: argparse.Namespace) -> None:
    """Make the missing episodes, compute the missing cases, print and write tables and pictures."""
    count = (FAST_EPISODE_COUNT if options.fast else EPISODE_COUNT) if options.episodes is None else options.episodes
    if count < 1 or options.first < 0:
        raise InvalidInput("--episodes, --first", got=f"{count}, {options.first}", expected="1 or more; 0 or more")
    networks = _find_networks(options.network)
    study = ResumableStudy(options.out, {"study": "pose_network", "fast": options.fast})
    study.start()
    seeds, fast = range(options.first, options.first + count), options.fast
    cases: dict[str, Callable[[], dict[str, Any]]] = {}
    for seed in seeds:
        load = partial(find_or_make_episode, options.out, seed, fast)
        cases[f"{seed:03d}, {SIMULATED}"] = partial(_simulated_case, load)
        cases[f"{seed:03d}, {REGISTERED}"] = partial(_registered_case, load)
        for label, path in networks.items():
            cases[_network_case(seed, ALONE, label, path)] = partial(_network_cases, load, path)
            cases[_network_case(seed, WITH_SIMULATION, label, path)] = partial(_smoothed_case, load, path, fast)
        if options.true_start:
            for kind in TRUE_START:
                cases[f"{seed:03d}, {kind}"] = partial(_true_start_case, load, kind == TRUE_START[1], fast)
    finished = study.run(cases)
    results = {
        seed: {"facts": _read_facts(options.out, seed), **_collect(finished, seed, networks, options.true_start)}
        for seed in seeds
    }
    print_tables(results, list(networks))
    path = write_result(options.out / "pose_network.json", "pose_network", {str(k): r for k, r in results.items()})
    write_text(options.out / "pose_network.md", to_markdown(results, list(networks)))
    write_picture(results, options.out / "pose_network.png")
    print(f"result: {path}, {options.out / 'pose_network.md'}, {options.out / 'pose_network.png'}")


def _find_networks(given: list[str] | None) -> dict[str, Path]:
    """Return files of weights by label; the shipped ones have an empty label."""
    if not given:
        return {"": SHIPPED_NETWORK} if SHIPPED_NETWORK.is_file() else {}
    out = {}
    for text in given:
        label, _, file = text.partition("=")
        if not label or not Path(file).is_file() or label in out:
            raise InvalidInput("--network", got=repr(text), expected="NAME=FILE of weights, each name once")
        load_network(Path(file))  # refused before hours of work
        out[label] = Path(file)
    return out


def _network_case(seed: int, method: str, label: str, path: Path) -> str:
    """Return the name of a case of a network: other weights make another case."""
    digest = hashlib.sha256(path.read_bytes()).hexdigest()[:8]
    return f"{seed:03d}, {method}, {label or 'shipped'} {digest}"


def _collect(
    finished: dict[str, dict[str, Any]], seed: int, networks: dict[str, Path], true_start: bool
) -> dict[str, Any]:
    """Return the results of an episode by method."""
    methods = {name: finished[f"{seed:03d}, {name}"] for name in (SIMULATED, REGISTERED)}
    for label, path in networks.items():
        suffix = f" ({label})" if label else ""
        alone = finished[_network_case(seed, ALONE, label, path)]
        methods |= {f"{name}{suffix}": alone[name] for name in (ALONE, WITH_PREVIOUS)}
        methods[f"{WITH_SIMULATION}{suffix}"] = finished[_network_case(seed, WITH_SIMULATION, label, path)]
    if true_start:
        methods |= {kind: finished[f"{seed:03d}, {kind}"] for kind in TRUE_START}
    return {"methods": methods}


# -- episodes ---------------------------------------------------------------------------------------------------------


def find_or_make_episode(out: Path, seed: int, fast: bool) -> HeldOut:
    """Return the episode of a seed; made once and then read from ``out``."""
    folder, truth_path = out / "episodes" / f"{seed:03d}", out / "truth" / f"{seed:03d}.npz"
    if not truth_path.exists():  # written last
        made = make_moving_recording(seed, FAST_SIZE if fast else None)
        recordings.write(made.recording, folder, overwrite=True)
        truth_path.parent.mkdir(parents=True, exist_ok=True)
        write_text(truth_path.with_suffix(".json"), to_json(_facts(made)))
        with write_atomically(truth_path) as part, part.open("wb") as file:
            np.savez(file, uv=made.uv, x=made.vertices.astype(np.float32), v=made.velocities.astype(np.float32))
    recording = recordings.read(folder)
    cloth = identification.build_cloth(recording)
    with np.load(truth_path) as truth:
        lines = [np.unique(truth["uv"][:, axis].round(9)) for axis in (0, 1)]
        sheet = SheetSpec(lines[0][-1], lines[1][-1], nodes=(len(lines[0]), len(lines[1])))
        uv = np.asarray(cloth.mesh.uv)
        x, v = (
            torch.as_tensor(np.stack([interpolate_bilinear(sheet, frame, uv)[0] for frame in truth[key].astype(float)]))
            for key in ("x", "v")
        )
    return HeldOut(recording, cloth, x, v, _read_facts(out, seed))


def _facts(made: MovingRecording) -> dict[str, Any]:
    names = ("grip", "motion", "camera", "truth", "occluded", "removed", "foreign")
    return {name: getattr(made, name) for name in names}


def _read_facts(out: Path, seed: int) -> dict[str, Any]:
    return json.loads((out / "truth" / f"{seed:03d}.json").read_text())


def with_first_state(scene: HeldOut, x: Tensor, v: Tensor | None = None) -> Recording:
    """Return the recording on the cloth's mesh with a first shape [V, 3] m and, in motion, velocities [V, 3] m/s."""
    mesh = scene.cloth.mesh
    info = replace(
        scene.recording.cloth,
        vertices=np.asarray(mesh.vertices),
        faces=np.asarray(mesh.faces),
        uv=np.asarray(mesh.uv),
        initial_vertices=x.numpy(),
        initial_velocities=None if v is None else v.numpy(),
    )
    return replace(scene.recording, cloth=info)


# -- methods ----------------------------------------------------------------------------------------------------------


def hanging_shape(scene: HeldOut) -> Tensor:
    """Return the shape [V, 3] m of the sheet at rest in its grippers at the first frame, without the truth.

    The heading of a sheet in a single gripper is the one that is nearest to the first cloud.
    """
    cloth, episode = scene.cloth, identification.build_episode(scene.cloth, scene.recording, has_first_shape=False)
    rest = rest_coordinates(cloth.mesh)
    first = next(k for k, cloud in enumerate(episode.clouds) if len(cloud))
    frame = build_scene_frame(pose_inputs(cloth, episode, first, rest))
    places = frame.rest_to_scene(rest[None].float())
    flat = frame.hang(places)
    flat[..., 1] += START_BULGE_M * torch.sin(torch.pi * places[..., 0]) / frame.scale
    x = frame.to_world(flat)[0].to(episode.initial)
    with torch.no_grad():
        start = float(episode.times[0])
        state = cloth.settle(cloth.state(x), episode.motion, start=start, duration=SETTLE_S, rate=SETTLE_RATE_PER_S)
    if len(episode.motion) > 1:
        return state.x
    gripper = interpolate_poses(next(iter(episode.motion.values())), episode.times[:1])[0, :3, 3]
    faces, candidates = torch.as_tensor(cloth.mesh.faces), []
    for angle in torch.arange(HEADING_COUNT) * (2 * torch.pi / HEADING_COUNT):
        c, s, one, zero = angle.cos(), angle.sin(), torch.ones(()), torch.zeros(())
        turn = torch.stack([c, -s, zero, s, c, zero, zero, zero, one]).reshape(3, 3).to(x)
        candidates.append(gripper + (state.x - gripper) @ turn.mT)
    distances = [float(chamfer_to_surface(episode.clouds[first], candidate, faces)) for candidate in candidates]
    return candidates[int(np.argmin(distances))]


def _simulated_case(load: Callable[[], HeldOut]) -> dict[str, Any]:
    """Compute the simulation that begins at rest, with the nominal fabric."""
    scene = load()
    began = time.process_time()
    episode = identification.build_episode(scene.cloth, with_first_state(scene, hanging_shape(scene)))
    with torch.no_grad():
        x = Replay(scene.cloth)(episode).x
    return score(x, scene) | {"cpu_seconds": time.process_time() - began}


def _registered_case(load: Callable[[], HeldOut]) -> dict[str, Any]:
    """Register every frame, the first one from the sheet at rest."""
    scene = load()
    began = time.process_time()
    episode = identification.build_episode(scene.cloth, with_first_state(scene, hanging_shape(scene)))
    gripped, positions = carry_grips(scene.cloth, episode)
    twice = replace(episode, clouds=[episode.clouds[0], *episode.clouds])  # the first shape is registered, too
    positions = torch.cat([positions[:1], positions])
    x = register_frames(twice, scene.cloth.mesh, gripped, positions, REGISTRATION_NOISE_STD_M)[1:]
    return score(x, scene) | {"cpu_seconds": time.process_time() - began}


def carry_grips(cloth: tc.Cloth, episode: Episode) -> tuple[Tensor, Tensor]:
    """Return the held vertices [H], and their places [T, H, 3] m as the grippers carry them from the first shape."""
    index, places = [], []
    for name, part in cloth.boundaries.items():
        if isinstance(part, Grasp):
            pose = interpolate_poses(episode.motion[name], episode.times)
            local = (episode.initial[part.index] - pose[0, :3, 3]) @ pose[0, :3, :3]
            index.append(part.index)
            places.append(local @ pose[:, :3, :3].mT + pose[:, None, :3, 3])
    return torch.cat(index), torch.cat(places, 1)


def _network_cases(load: Callable[[], HeldOut], path: Path) -> dict[str, Any]:
    """Compute what the network says of every frame, alone and from its estimate of the frame before."""
    scene, network = load(), load_network(path)
    episode = identification.build_episode(scene.cloth, scene.recording, has_first_shape=False)
    rest, out = rest_coordinates(scene.cloth.mesh), {}
    for name, uses_previous in ((ALONE, False), (WITH_PREVIOUS, True)):
        x, std, seconds = predict_frames(network, scene.cloth, episode, rest, uses_previous)
        out[name] = score(x, scene, std[..., None].expand_as(x)) | {"ms_per_cloud": 1e3 * float(np.median(seconds))}
    return out


def predict_frames(
    network: PoseEstimator, cloth: tc.Cloth, episode: Episode, rest: Tensor, uses_previous: bool
) -> tuple[Tensor, Tensor, list[float]]:
    """Return vertices [T, V, 3] m, standard deviations [T, V] m, and CPU seconds of each cloud, one at a time.

    A frame without a cloud has the estimate of the frame before.
    """
    x, std, seconds, previous = [], [], [], None
    with torch.no_grad():
        for t, cloud in enumerate(episode.clouds):
            if len(cloud) < MIN_POINTS_FOR_NETWORK:
                x.append(x[-1] if x else torch.full_like(rest, torch.nan))
                std.append(std[-1] if std else torch.full_like(rest[:, 0], torch.nan))
                continue
            for _ in range(WARM_UP_CALLS if not seconds else 1):
                began = time.process_time()
                answer = network(pose_inputs(cloth, episode, t, rest, previous))
                last = time.process_time() - began
            seconds.append(last)
            x.append(answer.x[0].double())
            std.append(answer.std[0].double())
            previous = x[-1] if uses_previous else None
    return torch.stack(x), torch.stack(std), seconds


def _smoothed_case(load: Callable[[], HeldOut], path: Path, fast: bool) -> dict[str, Any]:
    scene = load()
    return _estimate(scene, scene.recording, fast, start=load_network(path))


def _true_start_case(load: Callable[[], HeldOut], moves: bool, fast: bool) -> dict[str, Any]:
    scene = load()
    return _estimate(scene, with_first_state(scene, scene.x[0], scene.v[0] if moves else None), fast)


def _estimate(scene: HeldOut, recording: Recording, fast: bool, **options: Any) -> dict[str, Any]:
    """Compute the smoother's estimate, whose fabric is known to a factor of 2."""
    cloth = scene.cloth
    stiffness = float(cloth.get_submodule("material.youngs_modulus").value.detach())  # type: ignore[union-attr]
    drag = AirDrag.amplitudes["normal"].typical
    uncertain = {"youngs_modulus": (stiffness, STIFFNESS_FACTOR), "air.normal": (drag, DRAG_STD_FRACTION * drag)}
    modes = FAST_FORCE_MODES if fast else FORCE_MODES
    began = time.process_time()
    try:
        result = estimate_pose(
            cloth,
            recording,
            uncertain=uncertain,
            modes=modes,
            window=FORCE_WINDOW_S,
            checks=False,
            **options,
        )
    except (SimulationDiverged, TorchclothError) as error:
        return {"failed": str(error)}
    fit = {name: result.fit[name] for name in ("force_fraction", "converged", "unknowns")}
    uncorrected = score(result.uncorrected, scene)
    start = score(result.uncorrected[:1], scene)
    seconds = {"cpu_seconds": time.process_time() - began}
    return (
        score(result.x, scene, result.std)
        | fit
        | seconds
        | {"rms_start": start["rms"], "rms_uncorrected": uncorrected["rms"]}
    )


# -- scores -----------------------------------------------------------------------------------------------------------


def score(x: Tensor, scene: HeldOut, std: Tensor | None = None) -> dict[str, Any]:
    """Return distances from the truth [m], and the coverage of standard deviations.

    Args:
        x: [T, V, 3] m, of all frames or the first ones.
        scene: the episode.
        std: [T, V, 3] m.
    """
    episode = identification.build_episode(scene.cloth, scene.recording, has_first_shape=False)
    count = len(x)
    squared = (x - scene.x[:count]).square().sum(-1)
    clouds = replace(episode, clouds=episode.clouds[:count])
    hidden = ~find_seen_vertices(scene.x[:count], clouds, scene.cloth.mesh)
    per_frame, hidden_share = squared.mean(1).sqrt(), hidden.double().mean(1)
    much_hidden = per_frame[hidden_share >= MANY_HIDDEN]
    out = {
        "rms": float(squared.mean().sqrt()),
        "rms_hidden": float(squared[hidden].mean().sqrt()),
        "rms_first": float(per_frame[0]),
        "hidden_share": float(hidden_share.mean()),
        "rms_of_much_hidden_clouds": much_hidden.tolist(),
    }
    if std is None:
        return out
    free = torch.ones(x.shape[1], dtype=torch.bool)
    for part in scene.cloth.boundaries.values():
        free[part.index] = False  # type: ignore[index]
    inside = ((x - scene.x[:count]).abs() < Z_95 * std).double()[:, free]
    return out | {"coverage": float(inside.mean()), "std_rms": float(std.square().sum(-1).mean().sqrt())}
