"""Small episodes made by our own engine, to test the fit and not the physics.

Same-engine twins: the model that fits is the model that made the data (an inverse crime), softened by another mesh,
another substep and sensor noise. They show that the machinery finds what it should, says how well, and notices what it
cannot know. Whether the physics is right is asked of the shipped example, whose truth comes from another engine.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

import torchcloth as tc
from torchcloth import recordings as rec
from torchcloth.robots import replay

SIDE = 0.3  # m
THICKNESS = 1e-3  # m
CORNERS = {"left": (0.0, SIDE), "right": (SIDE, SIDE)}
RADIUS = 0.055  # m; holds about the same patch on both meshes
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
    grasps = {name: tc.boundaries.Grasp(uv=[corner], radius=RADIUS) for name, corner in CORNERS.items()}
    mesh = tc.meshes.rectangle(SIDE, SIDE, resolution=resolution)
    return tc.Cloth(mesh, material, fabric.density, effects, grasps, contact=None)


def swing(amplitude: float = 0.08, phase: float = 0.0, duration: float = 0.72) -> dict[str, rec.GripperMotion]:
    """Both grippers move together, forth and back across the sheet and along it; they start at rest."""
    t = np.linspace(0.0, duration, 37)
    ramp = 1 - np.cos(2 * np.pi * 1.4 * t)
    out = {}
    for name, (u, _) in CORNERS.items():
        position = np.stack([amplitude * ramp * np.cos(phase), u - SIDE / 2 + 0 * t, 1.0 + amplitude * ramp / 4], 1)
        quat = np.tile([1.0, 0.0, 0.0, 0.0], (len(t), 1))
        out[name] = rec.GripperMotion(t, position, quat, np.ones(len(t), bool))
    return out


def hanging(model: tc.Cloth) -> torch.Tensor:
    """[V, 3] m, the flat sheet below the grippers, very slightly bulged so that it has a side to move to."""
    u, v = torch.as_tensor(model.mesh.uv).T
    return torch.stack([1e-3 * torch.sin(torch.pi * u / SIDE) * (1 - v / SIDE), u - SIDE / 2, 1.0 - SIDE + v], dim=-1)


def bilinear(x: np.ndarray, shape: tuple[int, int], uv: np.ndarray) -> np.ndarray:
    """Positions [N, 3] m of material points on a grid of vertices."""
    columns, rows = shape
    place = np.clip(uv / SIDE, 0, 1) * [columns - 1, rows - 1]
    cell = np.minimum(place.astype(int), [columns - 2, rows - 2])
    a, b = (place - cell).T[:, :, None]
    at = lambda i, j: x[(cell[:, 0] + i) * rows + cell[:, 1] + j]  # noqa: E731
    return (1 - a) * (1 - b) * at(0, 0) + a * (1 - b) * at(1, 0) + (1 - a) * b * at(0, 1) + a * b * at(1, 1)


def twin(
    fabric: Fabric = TRUE, seed: int = 0, amplitude: float = 0.08, phase: float = 0.0, noise: float = NOISE
) -> rec.Recording:
    """One episode: clouds of the true sheet with noise, and the sheet's first shape on the coarser mesh of the fit."""
    rng = np.random.default_rng(seed)
    truth, mesh = cloth(fabric, TRUTH), tc.meshes.rectangle(SIDE, SIDE, resolution=FIT)
    motion = swing(amplitude, phase)
    t = np.arange(FRAMES) / RATE
    empty = rec.Recording(cloth=rec.ClothInfo(areal_density=1.0), provenance="synthetic: twins.py", grippers=motion)
    with torch.no_grad():
        trajectories = replay(empty)
        state = truth.settle(truth.state(hanging(truth)), trajectories, duration=1.0, rate=15.0)
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
        grasps={name: rec.GraspInfo(np.array([corner]), RADIUS) for name, corner in CORNERS.items()},
        grippers=motion,
        points=rec.PointClouds(t, xyz, np.full(FRAMES, POINTS)),
        observation_noise_std=noise,
        air_density=1.204,
    )


def shifted(recording: rec.Recording, offset: float) -> rec.Recording:
    """The same episode with the camera's clock ``offset`` seconds behind the motion's."""
    points = replace(recording.points, t=recording.points.t - offset)
    return replace(recording, points=points, clock_offset=offset)
