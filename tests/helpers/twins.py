"""Small episodes from the library's engine, to test the fit and not the physics.

The model that is fitted also made the data (an inverse crime), with another mesh, another substep and sensor noise.
The tests show that the fit recovers parameters, states their uncertainty and detects what is not identifiable. The
shipped example, whose truth comes from another engine, tests the physics.
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
from torchcloth.identification.uncertainty.model_error import SAME_SIMULATOR as SAME_SIMULATOR
from torchcloth.robots import replay

SIDE_M = 0.3
THICKNESS_M = 1e-3
GRASPED_EDGES_U_M = {"left": 0.0, "right": SIDE_M}  # u of the edge that each gripper holds along its length
JAW_V_M = np.linspace(0.0, SIDE_M, 61)
GRASP_RADIUS_M = 0.0018  # contains the vertices of the edge only, on all meshes of these tests
TRUTH_RESOLUTION, FIT_RESOLUTION = (11, 11), (7, 7)  # vertices along the sides
NOISE_M = 1e-3
FRAME_COUNT, FRAME_RATE_HZ = 15, 20.0  # 0.7 s
POINTS_PER_FRAME = 120


@dataclass(frozen=True)
class Fabric:
    """A soft and heavy fabric: few substeps, large and smooth response. SI units."""

    membrane: float = 40.0
    poisson: float = 0.25
    density: float = 0.3
    bending: float = 3e-5
    damping_time: float = 5e-3
    drag: float = 1.2


TRUE_FABRIC = Fabric()
NOMINAL_FABRIC = Fabric(membrane=80.0, poisson=0.15)  # values of the data sheet: a wrong start


def make_cloth(fabric: Fabric, resolution: tuple[int, int], drag: bool = True) -> tc.Cloth:
    """Return the sheet in two grippers."""
    effects = {"gravity": tc.effects.Gravity(), "bending": tc.effects.Bending(fabric.bending, fabric.damping_time)}
    if drag:
        effects["air"] = tc.effects.AirDrag(fabric.drag)
    material = tc.materials.AEP(fabric.membrane / THICKNESS_M, fabric.poisson, thickness=THICKNESS_M)
    grasps = {name: tc.boundaries.Grasp(uv=jaw_points(name), radius=GRASP_RADIUS_M) for name in GRASPED_EDGES_U_M}
    mesh = tc.meshes.rectangle(SIDE_M, SIDE_M, resolution=resolution)
    return tc.Cloth(mesh, material, fabric.density, effects, grasps, contact=None)


def jaw_points(name: str) -> np.ndarray:
    """Return pattern points [61, 2] m along an edge."""
    return np.stack([np.full_like(JAW_V_M, GRASPED_EDGES_U_M[name]), JAW_V_M], axis=1)


def make_shaking_motion(
    amplitude: float = 0.08, rate: float = 2.5, duration: float = 0.72
) -> dict[str, rec.GripperMotion]:
    """Return a motion of both grippers, up and down together. The sheet is taut, 3 % above its width."""
    t = np.linspace(0.0, duration, 37)
    height = 1.0 + 0.5 * amplitude * (1 - np.cos(2 * np.pi * rate * t))
    out = {}
    for name, u in GRASPED_EDGES_U_M.items():
        position = np.stack([0 * t, 1.03 * (u - SIDE_M / 2) + 0 * t, height], axis=1)
        quat = np.tile([1.0, 0.0, 0.0, 0.0], (len(t), 1))
        out[name] = rec.GripperMotion(t, position, quat, np.ones(len(t), bool))
    return out


def flat_positions(model: tc.Cloth) -> torch.Tensor:
    """Return positions [V, 3] m of the flat sheet between the grippers, before it sags."""
    u, v = torch.as_tensor(model.mesh.uv).T
    return torch.stack([v - SIDE_M / 2, 1.03 * (u - SIDE_M / 2), torch.ones_like(u)], dim=-1)


def interpolate_bilinear(x: np.ndarray, shape: tuple[int, int], uv: np.ndarray) -> np.ndarray:
    """Return positions [N, 3] m of material points on a grid of vertices."""
    columns, rows = shape
    place = np.clip(uv / SIDE_M, 0, 1) * [columns - 1, rows - 1]
    cell = np.minimum(place.astype(int), [columns - 2, rows - 2])
    a, b = (place - cell).T[:, :, None]
    first = cell[:, 0] * rows + cell[:, 1]
    low, high = ((1 - b) * x[first + skip] + b * x[first + skip + 1] for skip in (0, rows))
    return (1 - a) * low + a * high


def make_twin(
    fabric: Fabric = TRUE_FABRIC, seed: int = 0, amplitude: float = 0.08, rate: float = 2.5, noise: float = NOISE_M
) -> rec.Recording:
    """Return an episode: noisy clouds of the true sheet, and its first shape on the coarser mesh of the fit."""
    rng = np.random.default_rng(seed)
    truth, mesh = make_cloth(fabric, TRUTH_RESOLUTION), tc.meshes.rectangle(SIDE_M, SIDE_M, resolution=FIT_RESOLUTION)
    motion = make_shaking_motion(amplitude, rate)
    t = np.arange(FRAME_COUNT) / FRAME_RATE_HZ
    empty = rec.Recording(cloth=rec.ClothInfo(areal_density=1.0), provenance="synthetic: twins.py", grippers=motion)
    with torch.no_grad():
        trajectories = replay(empty)
        state = truth.settle(truth.state(flat_positions(truth)), trajectories, duration=1.0, rate=15.0)
        x = truth(state, trajectories, t.tolist(), dt=0.6 * truth.stable_step()).x.numpy()
    clouds = [interpolate_bilinear(frame, TRUTH_RESOLUTION, SIDE_M * rng.random((POINTS_PER_FRAME, 2))) for frame in x]
    xyz = np.concatenate(clouds) + noise * rng.standard_normal((FRAME_COUNT * POINTS_PER_FRAME, 3))
    return rec.Recording(
        cloth=rec.ClothInfo(
            areal_density=fabric.density,
            areal_density_std=0.005,
            thickness=THICKNESS_M,
            vertices=mesh.vertices,
            faces=mesh.faces,
            uv=mesh.uv,
            initial_vertices=interpolate_bilinear(x[0], TRUTH_RESOLUTION, np.asarray(mesh.uv)),
            nominal={
                "youngs_modulus": NOMINAL_FABRIC.membrane / THICKNESS_M,
                "poisson_ratio": NOMINAL_FABRIC.poisson,
                "bending_stiffness": NOMINAL_FABRIC.bending,
                "bending_damping_time": NOMINAL_FABRIC.damping_time,
            },
        ),
        provenance="synthetic: tests/helpers/twins.py",
        grasps={name: rec.GraspInfo(jaw_points(name), GRASP_RADIUS_M) for name in GRASPED_EDGES_U_M},
        grippers=motion,
        points=rec.PointClouds(t, xyz, np.full(FRAME_COUNT, POINTS_PER_FRAME)),
        observation_noise_std=noise,
        air_density=1.204,
    )


def shift_clock(recording: rec.Recording, offset: float) -> rec.Recording:
    """Return the episode with the camera's clock ``offset`` seconds behind the motion's."""
    points = replace(recording.points, t=recording.points.t - offset)
    return replace(recording, points=points, clock_offset=offset)


def take_first_frames(recording: rec.Recording, frames: int) -> rec.Recording:
    """Return the episode with the first frames only, at lower cost."""
    points = recording.points
    count = int(points.counts[:frames].sum())
    return replace(recording, points=rec.PointClouds(points.t[:frames], points.xyz[:count], points.counts[:frames]))


def build_cloth_at(recording: rec.Recording, **nominal: float) -> tc.Cloth:
    """Return the cloth of an episode with some start values changed."""
    model = identification.build_cloth(recording)
    for name, value in nominal.items():
        model.get_submodule(find_scalar_parameters(model)[name]).set(value)
    return model


@contextmanager
def use_float64():
    """Set float64 for session fixtures, which run before the fixture that sets it for each test."""
    default = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(default)
