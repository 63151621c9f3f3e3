"""Small episodes of a light sheet in two grippers, simulated by the library on another mesh."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

import torchcloth as tc
from torchcloth import recordings as rec
from torchcloth.diagnosis import World, build_base_model
from torchcloth.episodes.observed import Episode
from torchcloth.episodes.observed import build_episode as tensors
from torchcloth.episodes.pattern_interpolation import interpolate_on_pattern, interpolation_weights
from torchcloth.episodes.replay import Frames

SIDE_M = 0.2
TRUTH_RESOLUTION, FIT_RESOLUTION = (13, 13), (7, 7)
NOMINAL_VALUES = {
    "membrane_stiffness": 60.0,
    "poisson_ratio": 0.3,
    "bending_stiffness": 2e-4,
    "bending_damping_time": 0.01,
}
CAMERA_POSITION_M = (0.1, -1.2, 1.1)
FRAME_COUNT, FRAME_RATE_HZ, POINTS_PER_FRAME, NOISE_M = 16, 20.0, 80, 5e-4  # -, Hz, a frame, m


def make_swing(amplitude: float, rate: float, axis: int = 1) -> Callable[[np.ndarray], np.ndarray]:
    """Return the displacement [K, 3] m of both grippers as a function of time."""

    def displacement(t: np.ndarray) -> np.ndarray:
        out = np.zeros((len(t), 3))
        out[:, axis] = 0.5 * amplitude * (1 - np.cos(2 * np.pi * rate * t))
        return out

    return displacement


MOTIONS = {"slow": make_swing(0.06, 1.2), "fast": make_swing(0.10, 1.6), "lift": make_swing(0.05, 2.0, axis=2)}


def make_episode(
    motion: str = "slow", resolution: tuple[int, int] = FIT_RESOLUTION, duration: float = 0.3
) -> rec.Recording:
    """Return an episode whose observations are points on the first shape."""
    mesh = tc.meshes.rectangle(SIDE_M, SIDE_M, resolution=resolution)
    t, rng = np.linspace(0.0, duration, 2 + int(50 * duration)), np.random.default_rng(0)
    first = np.c_[mesh.uv[:, 0], 0.01 * np.sin(8 * mesh.uv[:, 0]), mesh.uv[:, 1]] + [0.0, 0.0, 1.0]
    grippers, grasps = {}, {}
    for name, u in (("left", 0.0), ("right", SIDE_M)):
        path = MOTIONS[motion](t) + np.array([u, 0.0, 1.0 + SIDE_M])
        grippers[name] = rec.GripperMotion(t, path, np.tile([1.0, 0, 0, 0], (len(t), 1)), np.ones(len(t), bool))
        grasps[name] = rec.GraspInfo(np.array([[u, SIDE_M]]), 0.051)
    frames = 1 + int(duration * FRAME_RATE_HZ)
    points = first[rng.integers(0, len(first), (frames, 40))] + 1e-3 * rng.standard_normal((frames, 40, 3))
    info = rec.ClothInfo(
        areal_density=0.2,
        areal_density_std=0.004,
        thickness=1e-3,
        vertices=np.c_[mesh.uv, np.zeros(len(first))],
        faces=mesh.faces,
        uv=mesh.uv,
        initial_vertices=first,
        nominal=NOMINAL_VALUES,
    )
    return rec.Recording(
        cloth=info,
        provenance="synthetic: tests/helpers/sheet_episodes.py",
        grasps=grasps,
        grippers=grippers,
        points=rec.PointClouds(np.arange(frames) / FRAME_RATE_HZ, points.reshape(-1, 3), np.full(frames, 40)),
        observation_noise_std=1e-3,
        cameras={
            "camera": rec.Camera(width=640, height=480, K=np.eye(3), T_world_camera=_camera_pose(CAMERA_POSITION_M))
        },
        split={"motion": motion},
    )


def _camera_pose(place: tuple[float, float, float]) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, 3] = place
    return pose


def record_changed_world(
    motion: str,
    change: Callable[[World], World],
    seed: int,
    play: Callable[[World, Episode], Frames] = World.simulate_observed,
) -> rec.Recording:
    """Return the noisy recording of a changed world on a finer mesh; the first shape is settled."""
    fine_episode, rng = (
        make_episode(motion, TRUTH_RESOLUTION, (FRAME_COUNT - 1) / FRAME_RATE_HZ + 0.01),
        np.random.default_rng(seed),
    )
    base_world = build_base_model(fine_episode).build_world()
    world, uv = change(base_world), np.asarray(fine_episode.cloth.uv)
    with torch.no_grad():
        data = tensors(world.cloth, fine_episode)
        state = world.cloth.settle(world.cloth.state(data.initial), data.motion, duration=1.0, rate=15.0)
        start = interpolate_on_pattern(interpolation_weights(world.cloth.mesh, uv), state.x)
        settled = replace(fine_episode, cloth=replace(fine_episode.cloth, initial_vertices=start.numpy()))
        frames = play(world, tensors(world.cloth, settled))
        x = interpolate_on_pattern(interpolation_weights(base_world.cloth.mesh, uv), frames.x).numpy()
    coarse = make_episode(motion, FIT_RESOLUTION, (FRAME_COUNT - 1) / FRAME_RATE_HZ + 0.01)
    clouds = [_sample_points(frame, rng) for frame in x]
    first = _interpolate_bilinear(x[0], np.asarray(coarse.cloth.uv)) + 2e-4 * rng.standard_normal(
        (len(coarse.cloth.uv), 3)
    )
    return replace(
        coarse,
        cloth=replace(coarse.cloth, initial_vertices=first),
        points=rec.PointClouds(
            np.arange(FRAME_COUNT) / FRAME_RATE_HZ, np.concatenate(clouds), np.full(FRAME_COUNT, POINTS_PER_FRAME)
        ),
        observation_noise_std=NOISE_M,
    )


def _sample_points(x: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return _interpolate_bilinear(x, SIDE_M * rng.random((POINTS_PER_FRAME, 2))) + NOISE_M * rng.standard_normal(
        (POINTS_PER_FRAME, 3)
    )


def _interpolate_bilinear(x: np.ndarray, uv: np.ndarray) -> np.ndarray:
    columns, rows = TRUTH_RESOLUTION
    place = np.clip(uv / SIDE_M, 0, 1) * [columns - 1, rows - 1]
    cell = np.minimum(place.astype(int), [columns - 2, rows - 2])
    a, b = (place - cell).T[:, :, None]
    first = cell[:, 0] * rows + cell[:, 1]
    low, high = ((1 - b) * x[first + skip] + b * x[first + skip + 1] for skip in (0, rows))
    return (1 - a) * low + a * high
