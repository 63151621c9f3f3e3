"""A square cloth that hangs from a gripper at rest, swinging, and at rest again; observed with known faults."""

import numpy as np

from torchcloth import recordings as rec

SIDE_M, NODES_PER_SIDE = 0.3, 8


def gripper_path(t):
    """Return gripper positions [T, 3] m: 1.5 s of rest, 4 s of strokes that never repeat, rest."""
    s = np.clip(t - 1.5, 0, 4)
    envelope = np.sin(np.pi * s / 4) ** 2
    y = 0.15 * envelope * np.sin(2 * np.pi * (0.5 * s + 0.1 * s**2))
    return np.stack([0 * t, y, 0.5 + 0.05 * envelope], -1)


def node_positions(t, nodes=NODES_PER_SIDE):
    """Return nodes [T, M, 3] m of the cloth, rows from the top; columns are straight and lean with the motion."""
    u, v = np.meshgrid(np.linspace(0, SIDE_M, nodes), np.linspace(0, SIDE_M, nodes))
    lean = 0.6 * np.gradient(gripper_path(t)[:, 1], t) if len(t) > 1 else np.zeros(1)
    down = np.stack([np.zeros_like(lean), -np.sin(lean), -np.cos(lean)], -1)
    across = np.array([1.0, 0.0, 0.0])
    return gripper_path(t)[:, None] + (u.ravel() - SIDE_M / 2)[:, None] * across + v.ravel()[:, None] * down[:, None]


def node_pattern():
    u, v = np.meshgrid(np.linspace(0, SIDE_M, NODES_PER_SIDE), np.linspace(0, SIDE_M, NODES_PER_SIDE))
    return np.stack([u.ravel(), SIDE_M - v.ravel()], -1)


def make_motion(rate=50.0, length=8.0):
    t = np.arange(0, length, 1 / rate)
    return rec.GripperMotion(t, gripper_path(t), np.tile([1.0, 0, 0, 0], (len(t), 1)), np.ones(len(t), bool))


def make_episode(**streams):
    cloth = rec.ClothInfo(areal_density=0.2, sheet=(SIDE_M, SIDE_M))
    return rec.Recording(cloth=cloth, grippers={"hand": make_motion()}, provenance="synthetic: tests", **streams)


def make_markers(noise=0.002, lag=0.0, rate=12.0, seed=0, **extra):
    """Return markers at even times, stamped ``lag`` s late."""
    t = np.arange(0.2, 7.2, 1 / rate)
    xyz = node_positions(t) + noise * np.random.default_rng(seed).standard_normal((len(t), NODES_PER_SIDE**2, 3))
    return rec.Markers(t + lag, xyz, **extra)


def make_clouds(noise=0.002, lag=0.0, rate=12.0, count=600, seed=0):
    """Return random points of the cloth, with noise along its normal."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.2, 7.2, 1 / rate)
    corners = node_positions(t, 2).reshape(len(t), 2, 2, 3)
    frames = []
    for (a, b), (c, _) in corners:
        u, v = rng.random((2, count, 1))
        normal = np.cross(b - a, c - a) / SIDE_M**2
        frames.append(a + u * (b - a) + v * (c - a) + noise * rng.standard_normal((count, 1)) * normal)
    return rec.PointClouds(t + lag, np.concatenate(frames), np.full(len(t), count))
