"""Small episodes made by our own engine, to test the fit and not the physics.

Same-engine twins: the model that fits is the model that made the data (an inverse crime), softened by another mesh,
another substep and sensor noise. They show that the machinery finds what it should, says how well, and notices what it
cannot know. Whether the physics is right is asked of the shipped example, whose truth comes from another engine.
"""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
import torch

import torchcloth as tc
from torchcloth import identification
from torchcloth import recordings as rec
from torchcloth.episodes.unknowns import find_scalar_parameters
from torchcloth.robots import replay

SIDE = 0.3  # m
THICKNESS = 1e-3  # m
EDGES = {"left": 0.0, "right": SIDE}  # u of the edge that each gripper's jaw holds in its whole length
JAW = np.linspace(0.0, SIDE, 61)
RADIUS = 0.0018  # m, holds the edge's vertices and no others, of any mesh used here
TRUTH, FIT = (11, 11), (7, 7)  # vertices along the sides
NOISE = 1e-3  # m
FRAMES, RATE = 15, 20.0  # 0.7 s
POINTS = 120  # a frame


@dataclass(frozen=True)
class Fabric:
    """Soft and heavy: few substeps, large and smooth response. SI units."""

    membrane: float = 40.0
    poisson: float = 0.25
    density: float = 0.3
    bending: float = 3e-5
    damping_time: float = 5e-3
    drag: float = 1.2


TRUE = Fabric()
NOMINAL = Fabric(membrane=80.0, poisson=0.15)  # the data sheet's values: a start that is wrong


def cloth(fabric: Fabric, resolution: tuple[int, int], drag: bool = True) -> tc.Cloth:
    """The sheet in two grippers."""
    effects = {"gravity": tc.effects.Gravity(), "bending": tc.effects.Bending(fabric.bending, fabric.damping_time)}
    if drag:
        effects["air"] = tc.effects.AirDrag(fabric.drag)
    material = tc.materials.AEP(fabric.membrane / THICKNESS, fabric.poisson, thickness=THICKNESS)
    grasps = {name: tc.boundaries.Grasp(uv=jaw(name), radius=RADIUS) for name in EDGES}
    mesh = tc.meshes.rectangle(SIDE, SIDE, resolution=resolution)
    return tc.Cloth(mesh, material, fabric.density, effects, grasps, contact=None)


def jaw(name: str) -> np.ndarray:
    """[61, 2] m, pattern points along an edge."""
    return np.stack([np.full_like(JAW, EDGES[name]), JAW], axis=1)


def shake(amplitude: float = 0.08, rate: float = 2.5, duration: float = 0.72) -> dict[str, rec.GripperMotion]:
    """Both grippers go up and down together; apart they stay at the sheet's width and 3 %, so that it is taut."""
    t = np.linspace(0.0, duration, 37)
    height = 1.0 + 0.5 * amplitude * (1 - np.cos(2 * np.pi * rate * t))
    out = {}
    for name, u in EDGES.items():
        position = np.stack([0 * t, 1.03 * (u - SIDE / 2) + 0 * t, height], axis=1)
        quat = np.tile([1.0, 0.0, 0.0, 0.0], (len(t), 1))
        out[name] = rec.GripperMotion(t, position, quat, np.ones(len(t), bool))
    return out


def hammock(model: tc.Cloth) -> torch.Tensor:
    """[V, 3] m, the flat sheet between the grippers, before it sags."""
    u, v = torch.as_tensor(model.mesh.uv).T
    return torch.stack([v - SIDE / 2, 1.03 * (u - SIDE / 2), torch.ones_like(u)], dim=-1)


def bilinear(x: np.ndarray, shape: tuple[int, int], uv: np.ndarray) -> np.ndarray:
    """Positions [N, 3] m of material points on a grid of vertices."""
    columns, rows = shape
    place = np.clip(uv / SIDE, 0, 1) * [columns - 1, rows - 1]
    cell = np.minimum(place.astype(int), [columns - 2, rows - 2])
    a, b = (place - cell).T[:, :, None]
    first = cell[:, 0] * rows + cell[:, 1]
    low, high = ((1 - b) * x[first + skip] + b * x[first + skip + 1] for skip in (0, rows))
    return (1 - a) * low + a * high


def twin(
    fabric: Fabric = TRUE, seed: int = 0, amplitude: float = 0.08, rate: float = 2.5, noise: float = NOISE
) -> rec.Recording:
    """One episode: clouds of the true sheet with noise, and the sheet's first shape on the coarser mesh of the fit."""
    rng = np.random.default_rng(seed)
    truth, mesh = cloth(fabric, TRUTH), tc.meshes.rectangle(SIDE, SIDE, resolution=FIT)
    motion = shake(amplitude, rate)
    t = np.arange(FRAMES) / RATE
    empty = rec.Recording(cloth=rec.ClothInfo(areal_density=1.0), provenance="synthetic: twins.py", grippers=motion)
    with torch.no_grad():
        trajectories = replay(empty)
        state = truth.settle(truth.state(hammock(truth)), trajectories, duration=1.0, rate=15.0)
        x = truth(state, trajectories, t.tolist(), dt=0.6 * truth.stable_step()).x.numpy()
    clouds = [bilinear(frame, TRUTH, SIDE * rng.random((POINTS, 2))) for frame in x]
    xyz = np.concatenate(clouds) + noise * rng.standard_normal((FRAMES * POINTS, 3))
    return rec.Recording(
        cloth=rec.ClothInfo(
            areal_density=fabric.density,
            areal_density_std=0.005,
            thickness=THICKNESS,
            vertices=mesh.vertices,
            faces=mesh.faces,
            uv=mesh.uv,
            initial_vertices=bilinear(x[0], TRUTH, np.asarray(mesh.uv)),
            nominal={
                "youngs_modulus": NOMINAL.membrane / THICKNESS,
                "poisson_ratio": NOMINAL.poisson,
                "bending_stiffness": NOMINAL.bending,
                "bending_damping_time": NOMINAL.damping_time,
            },
        ),
        provenance="synthetic: tests/identification/twins.py",
        grasps={name: rec.GraspInfo(jaw(name), RADIUS) for name in EDGES},
        grippers=motion,
        points=rec.PointClouds(t, xyz, np.full(FRAMES, POINTS)),
        observation_noise_std=noise,
        air_density=1.204,
    )


def shifted(recording: rec.Recording, offset: float) -> rec.Recording:
    """The same episode with the camera's clock ``offset`` seconds behind the motion's."""
    points = replace(recording.points, t=recording.points.t - offset)
    return replace(recording, points=points, clock_offset=offset)


def first(recording: rec.Recording, frames: int) -> rec.Recording:
    """The first frames only: enough where a test asks about the machinery, at half the cost."""
    points = recording.points
    kept = int(points.counts[:frames].sum())
    return replace(recording, points=rec.PointClouds(points.t[:frames], points.xyz[:kept], points.counts[:frames]))


def at(recording: rec.Recording, **nominal: float) -> tc.Cloth:
    """The cloth of an episode with some start values changed."""
    model = identification.build_cloth(recording)
    for name, value in nominal.items():
        model.get_submodule(find_scalar_parameters(model)[name]).set(value)
    return model


@contextmanager
def doubles():
    """float64 for what is made once for all tests, before the fixture that sets it for each."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(before)
