"""Small scenes that the cases share."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

import torchcloth as tc
from torchcloth.meshes import Mesh

STILL = 1e3  # s, how long a body that does not move is described


def still() -> tc.Trajectory:
    """A body that never moves."""
    return tc.Trajectory(torch.tensor([0.0, STILL]), torch.eye(4).repeat(2, 1, 1), torch.ones(2, dtype=torch.bool))


def path(t: Tensor, position: Tensor, closed: Tensor | None = None) -> tc.Trajectory:
    """A body that travels without turning: positions [..., K, 3] m at t [K] s."""
    pose = torch.eye(4).expand(*position.shape[:-1], 4, 4).clone()
    pose[..., :3, 3] = position
    return tc.Trajectory(t, pose, torch.ones(len(t), dtype=torch.bool) if closed is None else closed)


def smooth(s: Tensor) -> Tensor:
    """0 to 1 over s in [0, 1] without jumps in velocity or acceleration."""
    s = s.clamp(0, 1)
    return s**3 * (10 - 15 * s + 6 * s * s)


def rotation(axis: tuple[float, float, float], degrees: float) -> Tensor:
    """Rotation matrix [3, 3]."""
    a = torch.tensor(axis, dtype=torch.float64)
    x, y, z = (a / a.norm()).tolist()
    return torch.linalg.matrix_exp(math.radians(degrees) * torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]))


def momenta(cloth: tc.Cloth, state: tc.ClothState) -> tuple[Tensor, Tensor]:
    """Linear [..., 3] N s, angular about the origin [..., 3] N m s."""
    mass = cloth.model().mass.detach()
    return (mass * state.v).sum(-2), torch.linalg.cross(state.x, mass * state.v).sum(-2)


def total_energy(cloth: tc.Cloth, state: tc.ClothState) -> Tensor:
    """Kinetic and stored energy [...] J, bending included."""
    total = sum(value for value in cloth.energy(state).values())
    for part in cloth.effects.values():
        if isinstance(part, tc.effects.Bending):
            total = total + part.energy(part.coefficients(), state.x)
    return total


def rms(a: Tensor, b: Tensor) -> float:
    """Root mean square distance [m] over all vertices and frames."""
    return float((a - b).square().sum(-1).mean().sqrt())


def where(condition: np.ndarray) -> list[int]:
    """Indices of the vertices that satisfy it."""
    return np.flatnonzero(condition).tolist()


def strip(length: float, width: float, resolution: tuple[int, int], degrees: float = 0.0) -> Mesh:
    """A strip along x whose warp is turned by ``degrees`` against it."""
    mesh = tc.meshes.rectangle(length, width, resolution=resolution)
    a = math.radians(degrees)
    turn = np.array([[math.cos(a), -math.sin(a)], [math.sin(a), math.cos(a)]])
    return Mesh.build(mesh.vertices, mesh.faces, mesh.uv @ turn)


def stacked(lower: Mesh, upper: Mesh, offset: tuple[float, float, float]) -> Mesh:
    """Two sheets as one mesh, the lower one's vertices first."""
    vertices = np.concatenate([lower.vertices, upper.vertices + np.array(offset)])
    return Mesh.build(vertices, np.concatenate([lower.faces, upper.faces + len(lower.vertices)]))
