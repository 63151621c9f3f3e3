"""Small scenes and measures that the cases share."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

import torchcloth as tc
from torchcloth.meshes import Mesh

STATIONARY_DURATION_S = 1e3  # of the trajectory of a body that does not move


def stationary_trajectory() -> tc.Trajectory:
    """Return the trajectory of a body that never moves."""
    t = torch.tensor([0.0, STATIONARY_DURATION_S])
    return tc.Trajectory(t, torch.eye(4).repeat(2, 1, 1), torch.ones(2, dtype=torch.bool))


def translation_trajectory(t: Tensor, position: Tensor, closed: Tensor | None = None) -> tc.Trajectory:
    """Return the trajectory of a body that does not turn: positions [..., K, 3] m at t [K] s."""
    pose = torch.eye(4).expand(*position.shape[:-1], 4, 4).clone()
    pose[..., :3, 3] = position
    return tc.Trajectory(t, pose, torch.ones(len(t), dtype=torch.bool) if closed is None else closed)


def smooth_step(s: Tensor) -> Tensor:
    """Return 0 to 1 over s in [0, 1] without jumps in velocity or acceleration."""
    s = s.clamp(0, 1)
    return s**3 * (10 - 15 * s + 6 * s * s)


def rotation_matrix(axis: tuple[float, float, float], degrees: float) -> Tensor:
    """Return the rotation matrix [3, 3] about an axis."""
    a = torch.tensor(axis, dtype=torch.float64)
    x, y, z = (a / a.norm()).tolist()
    return torch.linalg.matrix_exp(math.radians(degrees) * torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]))


def compute_momenta(cloth: tc.Cloth, state: tc.ClothState) -> tuple[Tensor, Tensor]:
    """Return the linear momentum [..., 3] N s and the angular one about the origin [..., 3] N m s."""
    mass = cloth.build_model().mass.detach()
    return (mass * state.v).sum(-2), torch.linalg.cross(state.x, mass * state.v).sum(-2)


def total_energy(cloth: tc.Cloth, state: tc.ClothState) -> Tensor:
    """Return the kinetic and stored energy [...] J, bending included."""
    first, *others = cloth.energy(state).values()
    total = first
    for value in others:
        total = total + value
    for effect in cloth.effects.values():
        if isinstance(effect, tc.effects.Bending):
            total = total + effect.energy(effect.coefficients(), state.x)
    return total


def rms_distance(a: Tensor, b: Tensor) -> float:
    """Return the root mean square distance [m] over all vertices and frames."""
    return float((a - b).square().sum(-1).mean().sqrt())


def indices_where(condition: np.ndarray) -> list[int]:
    """Return the indices of the vertices at which a condition [V] holds."""
    return np.flatnonzero(condition).tolist()


def make_strip(length: float, width: float, resolution: tuple[int, int], degrees: float = 0.0) -> Mesh:
    """Return a strip along x whose warp is turned by ``degrees`` against it."""
    mesh = tc.meshes.rectangle(length, width, resolution=resolution)
    a = math.radians(degrees)
    turn = np.array([[math.cos(a), -math.sin(a)], [math.sin(a), math.cos(a)]])
    return Mesh.build(mesh.vertices, mesh.faces, mesh.uv @ turn)


def stack_sheets(lower: Mesh, upper: Mesh, offset: tuple[float, float, float]) -> Mesh:
    """Return two sheets as one mesh, the lower one's vertices first."""
    vertices = np.concatenate([lower.vertices, upper.vertices + np.array(offset)])
    return Mesh.build(vertices, np.concatenate([lower.faces, upper.faces + len(lower.vertices)]))
