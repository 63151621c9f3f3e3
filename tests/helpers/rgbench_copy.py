"""A small synthetic copy of the RGBench data set: a garment of 72 triangles, a fling and a fold, seen by a camera."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import torch
import yaml

import torchcloth as tc
from helpers import foreign_formats
from torchcloth import recordings as rec
from torchcloth.identification import build_cloth
from torchcloth.meshes import obj
from torchcloth.robots import replay

ARMS = ("left", "right")
GARMENT_SIDE_M = 0.3
CLOUD_RATE_HZ = 10.0
CLOUD_POINTS = 150
CLOUD_NOISE_STD_M = 1e-3
DURATION_S = 0.8
FIRST_SAMPLE_S = 1753623328.0  # epoch of the arms' first sample
CAMERA_POSE = np.array(foreign_formats.CAMERA_POSE)
GARMENT_ENTRIES = {
    "stretch": 230000,
    "bending": 1000,
    "density": 220,
    "friction": 0.6,
    "ground_friction": 0.266,
    "mass": 0.02,
    "poisson": 0.35,
}


def make_garment() -> tuple[tc.meshes.Mesh, list[int]]:
    """Return a square, flat as the benchmark's meshes are, and its corners at y = 0.15 and -0.15 m: the shoulders."""
    mesh = tc.meshes.rectangle(GARMENT_SIDE_M, GARMENT_SIDE_M, triangles=72)
    flat = np.stack([mesh.uv[:, 0], mesh.uv[:, 1] - GARMENT_SIDE_M / 2, np.full(len(mesh.uv), 0.005)], axis=-1)
    corners = [int(np.linalg.norm(flat[:, :2] - [0.0, y], axis=1).argmin()) for y in (0.15, -0.15)]
    return tc.meshes.Mesh.build(flat, mesh.faces), corners


def write_copy(data: Path) -> Path:
    """Write the data set with its configs, and return its folder."""
    mesh, shoulders = make_garment()
    t = np.arange(0.0, DURATION_S + 0.3, 0.01)
    share = 0.5 * (1 - np.cos(np.pi * np.clip(t / DURATION_S, 0, 1)))[:, None]
    upright = np.stack([0 * mesh.vertices[:, 0] + 0.3, mesh.vertices[:, 1], 0.6 - mesh.vertices[:, 0]], axis=-1)
    laid = np.add(mesh.vertices, [0.1, 0.0, -0.004])
    paths = {
        "fling": (upright, share * np.array([0.15, 0.0, 0.0])),
        "fold": (laid, share * np.array([0.3, 0.0, 0.0]) + 0.1 * np.sin(np.pi * share) * np.array([0.0, 0.0, 1.0])),
    }
    experiments = {}
    for action, (first, path) in paths.items():
        name = f"green_tshirt/green_tshirt_{action}_2025-07-19-19-14-58"
        _write_capture(data / name, mesh, first, {a: (k, path) for a, k in zip(ARMS, shoulders, strict=True)}, t)
        window = {"start_calculate_time": 0.0, "end_calculate_time": DURATION_S}
        entry = {"camera_delay": 1 / CLOUD_RATE_HZ, "data_subfolder": name, "evaluate": window}
        experiments[action] = {"piper": {"01": entry, "02": {**entry, "data_subfolder": f"{name}_not_here"}}}
    library = {"green_tshirt": experiments, "blue_dress": {"fold": experiments["fold"]}}
    (data / "configs" / "cloth_params").mkdir(parents=True)
    (data / "configs" / "experiment_library.yaml").write_text(yaml.safe_dump({"experiments": library}))
    (data / "meshes").mkdir()
    for garment, faces in (("green_tshirt", mesh.faces), ("blue_dress", [*mesh.faces, [0, 1, 40], [0, 1, 41]])):
        (data / "meshes" / f"{garment}.obj").write_text(obj.dump(mesh.vertices, np.array(faces), None))
        entries = {**GARMENT_ENTRIES, "cloth_model_file_name": f"{garment}.obj", "shoulder_index": shoulders}
        (data / "configs" / "cloth_params" / f"{garment}.yaml").write_text(yaml.safe_dump(entries))
    return data


def _write_capture(folder: Path, mesh, first: np.ndarray, hands: dict, t: np.ndarray) -> None:
    """Simulate a garment from its first shape, and write what arms and camera record.

    Args:
        folder: of the capture.
        mesh: of the garment.
        first: [V, 3] m, the first shape.
        hands: by arm, the vertex that it holds, and its path [K, 3] m.
        t: [K] s.
    """
    quat, closed = np.tile([1.0, 0.0, 0.0, 0.0], (len(t), 1)), np.ones(len(t), bool)
    motions = {arm: rec.GripperMotion(t, first[k] + path, quat, closed) for arm, (k, path) in hands.items()}
    recording = rec.Recording(
        cloth=rec.ClothInfo(
            areal_density=0.22,
            vertices=mesh.vertices,
            faces=mesh.faces,
            nominal={"membrane_stiffness": 230.0, "poisson_ratio": 0.35, "bending_stiffness": 1e-6},
        ),
        provenance="synthetic: tests",
        grasps={arm: rec.GraspInfo(vertices=np.array([k])) for arm, (k, _) in hands.items()},
        grippers=motions,
        colliders={"ground": rec.Collider(np.zeros(3), np.array([0.0, 0.0, 1.0]), 0.266)},
        air_density=1.2,
    )
    cloth, drive = build_cloth(recording), replay(recording)
    frames = np.arange(0.0, DURATION_S + 1e-9, 1 / CLOUD_RATE_HZ)
    with torch.no_grad():
        state = cloth.settle(cloth.state(torch.as_tensor(first)), drive, duration=2.0)
        x = cloth(state, drive, frames.tolist()).x.numpy()
    for name in ("calibration", "joints", "segment_pcds"):
        (folder / name).mkdir(parents=True)
    world_to_camera = np.linalg.inv(CAMERA_POSE)
    (folder / "calibration" / "world_to_camera_transform.json").write_text(json.dumps(world_to_camera.tolist()))
    rng = np.random.default_rng(0)
    for time, vertices in zip(frames, x, strict=True):
        corners = vertices[mesh.faces[rng.integers(0, len(mesh.faces), CLOUD_POINTS)]]
        cloud = (rng.dirichlet([1, 1, 1], CLOUD_POINTS)[:, :, None] * corners).sum(1)
        cloud += rng.normal(0, CLOUD_NOISE_STD_M, cloud.shape)
        stamp = FIRST_SAMPLE_S + time - 1 / CLOUD_RATE_HZ  # of the late camera
        seen = cloud @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]
        foreign_formats.write_cloud(folder / "segment_pcds" / f"pointcloud_{stamp:.6f}_segmented.pcd", seen)
    for arm, y in zip(ARMS, (0.25, -0.25), strict=True):
        path = folder / "joints" / f"{arm}_arm_joint_states_and_end_pose.csv"
        stamps = [f"{FIRST_SAMPLE_S + time:.6f}" for time in t]
        foreign_formats.write_poses(path, stamps, motions[arm].position - [0.0, y, 0.0], quat)
