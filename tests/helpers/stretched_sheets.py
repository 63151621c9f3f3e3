"""Cheap episodes of a sheet between two jaws, pulled and shaken, with force sensors and a camera in front.

The truth has another mesh with other diagonals, another step and other values than the model.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

import torchcloth as tc
from torchcloth import recordings as rec
from torchcloth.episodes.unknowns import find_scalar_parameters
from torchcloth.robots import replay
from torchcloth.training.studies.synthetic_sheets import interpolate_on_grid, simulate_readings

WIDTH_M, HEIGHT_M = 0.30, 0.20  # m, between the jaws and along them
THICKNESS_M = 1e-3
TRUTH_RESOLUTION, FIT_RESOLUTION = (22, 15), (13, 9)  # vertices
POINTS_PER_FRAME = 400  # before occlusion
FORCE_NOISE_N = 0.02  # white, at the knots
KNOT_RATE_HZ = 50.0
FRAME_COUNT, FRAME_RATE_HZ = 16, 15.0
VIEWING_DIRECTION = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Fabric:
    """Parameters of the fabric, SI units."""

    membrane: float = 60.0
    poisson: float = 0.3
    density: float = 0.25
    bending: float = 3e-5
    drag: float = 1.2


@dataclass(frozen=True)
class EpisodeSettings:
    """Motion, sensor and discretisation of an episode."""

    strain: float = 0.06
    heave: float = 0.05  # m
    depth: float = 1.0e-3  # m, noise along the camera's axis
    lateral: float = 0.35e-3  # m, a quarter of a pixel
    occluded: float = 0.3  # of the sheet's length, a bar in front of it
    grasp: float = 0.5e-3  # m, error of the first shape at each jaw, linear between them
    initial: float = 0.2e-3  # m, further error of it at every free vertex
    clock: float = 0.0  # s
    resolution: tuple[int, int] = TRUTH_RESOLUTION
    points: int = POINTS_PER_FRAME
    frames: int = FRAME_COUNT
    rate: float = FRAME_RATE_HZ  # 1/s


def make_cloth(fabric: Fabric, resolution: tuple[int, int]) -> tc.Cloth:
    """Return the sheet with its two short sides in jaws."""
    mesh = tc.meshes.rectangle(WIDTH_M, HEIGHT_M, resolution=resolution)
    effects = {
        "gravity": tc.effects.Gravity(),
        "bending": tc.effects.Bending(fabric.bending, 5e-3),
        "air": tc.effects.AirDrag(fabric.drag),
    }
    material = tc.materials.AEP(fabric.membrane / THICKNESS_M, fabric.poisson, thickness=THICKNESS_M)
    grasps = {name: tc.boundaries.Grasp(uv=jaw_points(name), radius=GRASP_RADIUS_M) for name in GRASPED_SIDES_U_M}
    return tc.Cloth(mesh, material, fabric.density, effects, grasps, contact=None)


GRASPED_SIDES_U_M = {"left": 0.0, "right": WIDTH_M}
GRASP_RADIUS_M = 0.006


def jaw_points(name: str) -> np.ndarray:
    """Return pattern points [41, 2] m along a side."""
    along = np.linspace(0.0, HEIGHT_M, 41)
    return np.stack([np.full_like(along, GRASPED_SIDES_U_M[name]), along], axis=1)


def make_pulling_motion(setting: EpisodeSettings) -> dict[str, rec.GripperMotion]:
    """Return a motion: apart and back once, up and down twice."""
    end = (setting.frames - 1) / setting.rate + 0.2
    t = np.arange(0.0, end, 1 / KNOT_RATE_HZ)
    elongation = 0.01 + 0.5 * setting.strain * (1 - np.cos(2 * np.pi * np.clip(t, 0, 1.0)))
    lift = 0.5 * setting.heave * (1 - np.cos(2 * np.pi * 2.0 * np.clip(t, 0, 1.0)))
    out = {}
    for name, u in GRASPED_SIDES_U_M.items():
        x = (u - WIDTH_M / 2) * (1 + elongation)
        position = np.stack([x, 0 * t, 1.0 + lift], axis=1)
        out[name] = rec.GripperMotion(t, position, np.tile([1.0, 0, 0, 0], (len(t), 1)), np.ones(len(t), bool))
    return out


def flat_positions(mesh: tc.meshes.Mesh) -> torch.Tensor:
    """Return positions [V, 3] m of the taut sheet between the jaws at the first knot."""
    u, v = torch.as_tensor(mesh.uv).T
    return torch.stack([1.01 * (u - WIDTH_M / 2), v - HEIGHT_M / 2, torch.ones_like(u)], dim=-1)


def interpolate(x: np.ndarray, shape: tuple[int, int], uv: np.ndarray) -> np.ndarray:
    """Return positions [N, 3] m of material points on a grid of vertices."""
    return interpolate_on_grid(x, shape, uv / [WIDTH_M, HEIGHT_M])


def record_episode(
    fabric: Fabric | None = None, seed: int = 0, setting: EpisodeSettings | None = None, markers: int = 0
) -> rec.Recording:
    """Return an episode: clouds, forces, a noisy first shape on the model's mesh, and ``markers`` per side if not 0."""
    fabric, setting = fabric or Fabric(), setting or EpisodeSettings()
    rng = np.random.default_rng(seed)
    truth, mesh = (
        make_cloth(fabric, setting.resolution),
        tc.meshes.rectangle(WIDTH_M, HEIGHT_M, resolution=FIT_RESOLUTION),
    )
    motion = make_pulling_motion(setting)
    motion_recording = rec.Recording(
        cloth=rec.ClothInfo(areal_density=1.0), provenance="synthetic: stretched_sheets.py", grippers=motion
    )
    knots = motion["left"].t
    frames = np.arange(setting.frames) / setting.rate
    times = np.union1d(knots[knots <= frames[-1] + 0.15], frames + setting.clock)
    with torch.no_grad():
        trajectories = replay(motion_recording)
        state = truth.settle(truth.state(flat_positions(truth.mesh)), trajectories, duration=0.6)
        out = truth(state, trajectories, times.tolist(), dt=0.6 * truth.stable_step())
    forces = {name: simulate_readings(out, name, knots, FORCE_NOISE_N, rng) for name in motion}
    x = out.x[np.searchsorted(times, frames + setting.clock)].numpy()
    clouds = [_sample_cloud(frame, setting, rng) for frame in x]
    first = interpolate(out.x[0].numpy(), setting.resolution, np.asarray(mesh.uv))
    return rec.Recording(
        cloth=rec.ClothInfo(
            areal_density=fabric.density,
            areal_density_std=0.005,
            thickness=THICKNESS_M,
            vertices=mesh.vertices,
            faces=mesh.faces,
            uv=mesh.uv,
            initial_vertices=first + _draw_first_error(np.asarray(mesh.uv), setting, rng),
        ),
        provenance="synthetic: tests/helpers/stretched_sheets.py",
        grasps={name: rec.GraspInfo(jaw_points(name), GRASP_RADIUS_M) for name in GRASPED_SIDES_U_M},
        grippers={name: replace(m, force=forces[name]) for name, m in motion.items()},
        points=rec.PointClouds(frames, np.concatenate(clouds), np.array([len(c) for c in clouds])),
        markers=_make_markers(x, frames, markers, setting, rng) if markers else None,
        observation_noise_std=setting.depth,
        air_density=1.204,
    )


def _sample_cloud(x: np.ndarray, setting: EpisodeSettings, rng: np.random.Generator) -> np.ndarray:
    uv = rng.random((setting.points, 2)) * [WIDTH_M, HEIGHT_M]
    hidden = np.abs(uv[:, 0] / WIDTH_M - 0.62) < 0.5 * setting.occluded
    points = interpolate(x, setting.resolution, uv[~hidden])
    noise = rng.standard_normal(points.shape)
    return points + noise * (setting.lateral * (1 - VIEWING_DIRECTION) + setting.depth * VIEWING_DIRECTION)


def _draw_first_error(uv: np.ndarray, setting: EpisodeSettings, rng: np.random.Generator) -> np.ndarray:
    """Return errors [V, 3] m as of a shape that was fitted to an image: smooth along the sheet, and noise."""
    share = uv[:, :1] / WIDTH_M
    left, right = setting.grasp * rng.standard_normal((2, 3))
    free = (uv[:, :1] > 1e-6) & (uv[:, :1] < WIDTH_M - 1e-6)
    return (1 - share) * left + share * right + setting.initial * free * rng.standard_normal((len(uv), 3))


def _make_markers(
    x: np.ndarray, t: np.ndarray, side: int, setting: EpisodeSettings, rng: np.random.Generator
) -> rec.Markers:
    """Return a grid of markers; a fifth of the observations is missing."""
    u, v = np.meshgrid(np.linspace(0.1, 0.9, side) * WIDTH_M, np.linspace(0.1, 0.9, side) * HEIGHT_M)
    uv = np.stack([u.ravel(), v.ravel()], axis=1)
    xyz = np.stack([interpolate(frame, setting.resolution, uv) for frame in x])
    xyz += 0.3e-3 * rng.standard_normal(xyz.shape)
    xyz[rng.random(xyz.shape[:2]) < 0.2] = np.nan
    return rec.Markers(t, xyz, uv)


def remesh_recording(recording: rec.Recording, resolution: tuple[int, int]) -> rec.Recording:
    """Return the episode on another mesh of the model, with the interpolated first shape."""
    mesh = tc.meshes.rectangle(WIDTH_M, HEIGHT_M, resolution=resolution)
    info = recording.cloth
    first = interpolate(info.initial_vertices, FIT_RESOLUTION, np.asarray(mesh.uv))
    info = replace(info, vertices=mesh.vertices, faces=mesh.faces, uv=mesh.uv, initial_vertices=first)
    return replace(recording, cloth=info)


def build_start_cloth(
    recording: rec.Recording, resolution: tuple[int, int] = FIT_RESOLUTION, **start: float
) -> tc.Cloth:
    """Return the cloth of an episode with some start values; the others are wrong."""
    start_cloth = make_cloth(Fabric(membrane=150.0, poisson=0.2, density=recording.cloth.areal_density), resolution)
    for name, value in start.items():
        start_cloth.get_submodule(find_scalar_parameters(start_cloth)[name]).set(value)
    return start_cloth
