"""Cheap episodes of a sheet between two jaws, pulled and shaken, with force sensors and a camera in front.

The truth has another mesh (and diagonals the other way), another step and, of course, other values than the model.
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

WIDTH, HEIGHT = 0.30, 0.20  # m, between the jaws and along them
THICKNESS = 1e-3  # m
TRUTH, FIT = (22, 15), (13, 9)  # vertices
POINTS = 400  # a frame, before occlusion
FORCE_NOISE = 0.02  # N, white, at the knots
KNOTS = 50.0  # 1/s
FRAMES, RATE = 16, 15.0
FACING = np.array([0.0, 0.0, 1.0])  # the camera looks along it


@dataclass(frozen=True)
class Fabric:
    """SI units."""

    membrane: float = 60.0
    poisson: float = 0.3
    density: float = 0.25
    bending: float = 3e-5
    drag: float = 1.2


@dataclass(frozen=True)
class Setting:
    """How it is pulled and seen."""

    strain: float = 0.06
    heave: float = 0.05  # m
    depth: float = 1.0e-3  # m, noise along the camera's axis
    lateral: float = 0.35e-3  # m, a quarter of a pixel
    occluded: float = 0.3  # of the sheet's length, a bar in front of it
    grasp: float = 0.5e-3  # m, error of the first shape at each jaw, and linearly between them
    initial: float = 0.2e-3  # m, more of it at every free vertex
    clock: float = 0.0  # s
    resolution: tuple[int, int] = TRUTH
    points: int = POINTS
    frames: int = FRAMES
    rate: float = RATE  # 1/s


def cloth(fabric: Fabric, resolution: tuple[int, int]) -> tc.Cloth:
    """The sheet, its two short sides in jaws."""
    mesh = tc.meshes.rectangle(WIDTH, HEIGHT, resolution=resolution)
    effects = {
        "gravity": tc.effects.Gravity(),
        "bending": tc.effects.Bending(fabric.bending, 5e-3),
        "air": tc.effects.AirDrag(fabric.drag),
    }
    material = tc.materials.AEP(fabric.membrane / THICKNESS, fabric.poisson, thickness=THICKNESS)
    grasps = {name: tc.boundaries.Grasp(uv=jaw(name), radius=RADIUS) for name in SIDES}
    return tc.Cloth(mesh, material, fabric.density, effects, grasps, contact=None)


SIDES = {"left": 0.0, "right": WIDTH}
RADIUS = 0.006  # m


def jaw(name: str) -> np.ndarray:
    """[41, 2] m, pattern points along a side."""
    along = np.linspace(0.0, HEIGHT, 41)
    return np.stack([np.full_like(along, SIDES[name]), along], axis=1)


def pull(setting: Setting) -> dict[str, rec.GripperMotion]:
    """Apart and back once, up and down twice."""
    end = (setting.frames - 1) / setting.rate + 0.2
    t = np.arange(0.0, end, 1 / KNOTS)
    part = 0.01 + 0.5 * setting.strain * (1 - np.cos(2 * np.pi * np.clip(t, 0, 1.0)))
    lift = 0.5 * setting.heave * (1 - np.cos(2 * np.pi * 2.0 * np.clip(t, 0, 1.0)))
    out = {}
    for name, u in SIDES.items():
        x = (u - WIDTH / 2) * (1 + part)
        position = np.stack([x, 0 * t, 1.0 + lift], axis=1)
        out[name] = rec.GripperMotion(t, position, np.tile([1.0, 0, 0, 0], (len(t), 1)), np.ones(len(t), bool))
    return out


def flat(mesh: tc.meshes.Mesh) -> torch.Tensor:
    """[V, 3] m, taut between the jaws at the first knot."""
    u, v = torch.as_tensor(mesh.uv).T
    return torch.stack([1.01 * (u - WIDTH / 2), v - HEIGHT / 2, torch.ones_like(u)], dim=-1)


def at(x: np.ndarray, shape: tuple[int, int], uv: np.ndarray) -> np.ndarray:
    """Positions [N, 3] m of material points on a grid of vertices."""
    return interpolate_on_grid(x, shape, uv / [WIDTH, HEIGHT])


def record(
    fabric: Fabric | None = None, seed: int = 0, setting: Setting | None = None, markers: int = 0
) -> rec.Recording:
    """One episode: clouds, forces, and a noisy first shape on the model's mesh; ``markers`` a side where asked for."""
    fabric, setting = fabric or Fabric(), setting or Setting()
    rng = np.random.default_rng(seed)
    truth, mesh = cloth(fabric, setting.resolution), tc.meshes.rectangle(WIDTH, HEIGHT, resolution=FIT)
    motion = pull(setting)
    bare = rec.Recording(cloth=rec.ClothInfo(areal_density=1.0), provenance="synthetic: stretches.py", grippers=motion)
    knots = motion["left"].t
    frames = np.arange(setting.frames) / setting.rate
    times = np.union1d(knots[knots <= frames[-1] + 0.15], frames + setting.clock)
    with torch.no_grad():
        moves = replay(bare)
        state = truth.settle(truth.state(flat(truth.mesh)), moves, duration=0.6)
        out = truth(state, moves, times.tolist(), dt=0.6 * truth.stable_step())
    forces = {name: simulate_readings(out, name, knots, FORCE_NOISE, rng) for name in motion}
    x = out.x[np.searchsorted(times, frames + setting.clock)].numpy()
    clouds = [_cloud(frame, setting, rng) for frame in x]
    first = at(out.x[0].numpy(), setting.resolution, np.asarray(mesh.uv))
    return rec.Recording(
        cloth=rec.ClothInfo(
            areal_density=fabric.density,
            areal_density_std=0.005,
            thickness=THICKNESS,
            vertices=mesh.vertices,
            faces=mesh.faces,
            uv=mesh.uv,
            initial_vertices=first + _first_error(np.asarray(mesh.uv), setting, rng),
        ),
        provenance="synthetic: tests/identification/stretches.py",
        grasps={name: rec.GraspInfo(jaw(name), RADIUS) for name in SIDES},
        grippers={name: replace(m, force=forces[name]) for name, m in motion.items()},
        points=rec.PointClouds(frames, np.concatenate(clouds), np.array([len(c) for c in clouds])),
        markers=_markers(x, frames, markers, setting, rng) if markers else None,
        observation_noise_std=setting.depth,
        air_density=1.204,
    )


def _cloud(x: np.ndarray, setting: Setting, rng: np.random.Generator) -> np.ndarray:
    uv = rng.random((setting.points, 2)) * [WIDTH, HEIGHT]
    hidden = np.abs(uv[:, 0] / WIDTH - 0.62) < 0.5 * setting.occluded
    points = at(x, setting.resolution, uv[~hidden])
    noise = rng.standard_normal(points.shape)
    return points + noise * (setting.lateral * (1 - FACING) + setting.depth * FACING)


def _first_error(uv: np.ndarray, setting: Setting, rng: np.random.Generator) -> np.ndarray:
    """[V, 3] m: as a shape that was fitted to an image is off, smoothly."""
    share = uv[:, :1] / WIDTH
    left, right = setting.grasp * rng.standard_normal((2, 3))
    free = (uv[:, :1] > 1e-6) & (uv[:, :1] < WIDTH - 1e-6)
    return (1 - share) * left + share * right + setting.initial * free * rng.standard_normal((len(uv), 3))


def _markers(x: np.ndarray, t: np.ndarray, side: int, setting: Setting, rng: np.random.Generator) -> rec.Markers:
    """A grid of material points, a fifth of the sightings lost."""
    u, v = np.meshgrid(np.linspace(0.1, 0.9, side) * WIDTH, np.linspace(0.1, 0.9, side) * HEIGHT)
    uv = np.stack([u.ravel(), v.ravel()], axis=1)
    xyz = np.stack([at(frame, setting.resolution, uv) for frame in x])
    xyz += 0.3e-3 * rng.standard_normal(xyz.shape)
    xyz[rng.random(xyz.shape[:2]) < 0.2] = np.nan
    return rec.Markers(t, xyz, uv)


def remeshed(recording: rec.Recording, resolution: tuple[int, int]) -> rec.Recording:
    """The same episode on another mesh of the model: its first shape is interpolated."""
    mesh = tc.meshes.rectangle(WIDTH, HEIGHT, resolution=resolution)
    info = recording.cloth
    first = at(info.initial_vertices, FIT, np.asarray(mesh.uv))
    info = replace(info, vertices=mesh.vertices, faces=mesh.faces, uv=mesh.uv, initial_vertices=first)
    return replace(recording, cloth=info)


def model(recording: rec.Recording, resolution: tuple[int, int] = FIT, **start: float) -> tc.Cloth:
    """The cloth of an episode with some start values, by default wrong ones."""
    found = cloth(Fabric(membrane=150.0, poisson=0.2, density=recording.cloth.areal_density), resolution)
    for name, value in start.items():
        found.get_submodule(find_scalar_parameters(found)[name]).set(value)
    return found
