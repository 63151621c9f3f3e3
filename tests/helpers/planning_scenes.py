"""Episodes to plan in: the upper edge of a small sheet is in a free gripper, or in that of a Rizon 4."""

from __future__ import annotations

import numpy as np
import torch

import torchcloth as tc
from torchcloth import recordings as rec
from torchcloth.identification import build_cloth

SIDE_M = 0.2
DURATION_S = 0.4
UPPER_EDGE_M = np.stack([np.linspace(0.0, SIDE_M, 7), np.full(7, SIDE_M)], axis=-1)
NOMINAL_VALUES = {"membrane_stiffness": 50.0, "poisson_ratio": 0.3, "bending_stiffness": 3e-5}


def describe_cloth(x: np.ndarray, mesh: tc.meshes.Mesh) -> rec.ClothInfo:
    return rec.ClothInfo(
        areal_density=0.3,
        thickness=1e-3,
        vertices=mesh.vertices,
        faces=mesh.faces,
        uv=mesh.uv,
        initial_vertices=x,
        nominal=NOMINAL_VALUES,
    )


def _hang_sheet(corner: np.ndarray) -> tuple[np.ndarray, tc.meshes.Mesh]:
    """Return positions of a vertical sheet with this upper left corner, and its mesh."""
    mesh = tc.meshes.rectangle(SIDE_M, SIDE_M, triangles=72)
    u, v = mesh.uv.T
    return corner + np.stack([0 * u, u, v - SIDE_M], axis=-1), mesh


def make_hand_episode(table: float | None = None) -> rec.Recording:
    """Return the episode of a free gripper that moves 3 cm along x, over a table at height ``table`` [m] if given."""
    t = np.linspace(0.0, DURATION_S, 41)
    x, mesh = _hang_sheet(np.array([0.0, 0.0, 0.5]))
    s = t / DURATION_S
    place = np.array([0.0, 0.0, 0.5]) + np.stack([0.03 * (3 * s**2 - 2 * s**3), 0 * t, 0 * t], axis=-1)
    colliders = {} if table is None else {"table": rec.Collider(np.array([0, 0, table]), np.array([0.0, 0, 1]), 0.4)}
    return rec.Recording(
        cloth=describe_cloth(x, mesh),
        grasps={"hand": rec.GraspInfo(uv=UPPER_EDGE_M, radius=0.02)},
        grippers={"hand": rec.GripperMotion(t, place, np.tile([1.0, 0, 0, 0], (41, 1)), np.ones(41, bool))},
        colliders=colliders,
        air_density=1.204,
        provenance="synthetic: a test",
    )


def make_arm_episode() -> rec.Recording:
    """Return the episode of a Rizon 4 that turns its first joint by 0.05 rad and back."""
    arm = tc.robots.load("rizon4", frame="tcp_closed")
    t = torch.linspace(0.0, DURATION_S, 41, dtype=torch.float64)
    q = arm.home.repeat(41, 1)
    q[:, 0] += 0.025 * (1 - torch.cos(2 * torch.pi * t / DURATION_S))
    corner = arm(arm.home)[:3, 3].numpy()
    x, mesh = _hang_sheet(corner)
    return rec.Recording(
        cloth=describe_cloth(x, mesh),
        grasps={"arm": rec.GraspInfo(uv=UPPER_EDGE_M, radius=0.02)},
        joints={"arm": rec.JointMotion(t.numpy(), q.numpy(), closed=np.ones(41, bool))},
        robots={"arm": rec.RobotInfo("rizon4", np.eye(4), "tcp_closed")},
        air_density=1.204,
        provenance="synthetic: a test",
    )


def build_nominal_cloth(recording: rec.Recording) -> tc.Cloth:
    """Return the cloth with the values of the data sheet."""
    return build_cloth(recording)
