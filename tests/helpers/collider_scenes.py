"""Scenes for the tests of colliders."""

import math

import numpy as np
import torch

import torchcloth as tc

GRAVITY_M_PER_S2 = 9.81


def make_sheet(
    boundaries, gravity=(0.0, 0.0, -GRAVITY_M_PER_S2), size=0.1, n=4, effects=None, E=1e5, density=0.15, shape=None
):
    mesh = tc.meshes.rectangle(*(shape or (size, size)), resolution=n if isinstance(n, tuple) else (n, n))
    forces = {"gravity": tc.effects.Gravity(gravity)} if gravity is not None else {}
    return tc.Cloth(mesh, tc.materials.AEP(E, 0.05), density, forces | (effects or {}), boundaries, contact=None)


def make_trajectory(t, position, rotation=None):
    """Return a trajectory from positions [K, 3] and rotations [K, 3, 3]."""
    t = torch.as_tensor(t)
    pose = torch.eye(4).repeat(len(t), 1, 1)
    pose[:, :3, 3] = torch.as_tensor(position)
    if rotation is not None:
        pose[:, :3, :3] = rotation
    return tc.Trajectory(t, pose, torch.ones(len(t), dtype=bool))


def rotate_about_z(angle):
    c, s, o = torch.cos(angle), torch.sin(angle), torch.zeros_like(angle)
    return torch.stack([c, -s, o, s, c, o, o, o, o + 1], -1).reshape(-1, 3, 3)


def make_box_mesh(size, centre):
    """Return vertices and faces of a box."""
    corners = np.array([[i, j, k] for i in (-0.5, 0.5) for j in (-0.5, 0.5) for k in (-0.5, 0.5)])
    faces = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]]
    faces += [[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
    return corners * np.array(size) + np.array(centre), np.array(faces)


def translate_along_z(z):
    pose = torch.eye(4)
    pose[2, 3] = z
    return pose


def simulate_sliding(body, angle, direction=(1.0, 0.0), start=0.0, time=0.3):
    """Return displacement [V, 3] m and final velocity [V, 3] m/s of a sheet on a body at z = 0 under tilted gravity."""
    a, b = direction
    cloth = make_sheet(
        {"body": body},
        (
            GRAVITY_M_PER_S2 * math.sin(angle) * a,
            GRAVITY_M_PER_S2 * math.sin(angle) * b,
            -GRAVITY_M_PER_S2 * math.cos(angle),
        ),
    )
    x = cloth.rest_state().x - torch.tensor([0.05, 0.05, 0.0])
    v = torch.zeros_like(x)
    v[:, 0], v[:, 1] = start * a, start * b
    with torch.no_grad():
        out = cloth(cloth.state(x, v), times=[0.0, time])
    return out.x[-1] - x, out.v[-1]
