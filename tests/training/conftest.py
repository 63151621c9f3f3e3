"""Tiny episodes for the fits: a sheet of 32 triangles shaken for two frames."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from helpers import twins

from torchcloth import recordings as rec

SMALL = (5, 5)


def tiny(amplitude: float, motion: str = "shake") -> rec.Recording:
    """Two frames after the first, noise-free points on the true sheet (E h = 40 N/m, the data sheet says 80)."""
    cloth = twins.make_cloth(twins.TRUE_FABRIC, SMALL)
    drive = twins.make_shaking_motion(amplitude)
    t = np.array([0.0, 0.05, 0.1])
    info = rec.ClothInfo(
        areal_density=twins.TRUE_FABRIC.density,
        thickness=twins.THICKNESS_M,
        vertices=cloth.mesh.vertices,
        faces=cloth.mesh.faces,
        uv=cloth.mesh.uv,
        nominal={
            "membrane_stiffness": 80.0,
            "poisson_ratio": 0.25,
            "bending_stiffness": 3e-5,
            "bending_damping_time": 5e-3,
        },
    )
    with torch.no_grad():
        trajectories = twins.replay(rec.Recording(cloth=info, provenance="synthetic: tests", grippers=drive))
        state = cloth.settle(cloth.state(twins.flat_positions(cloth)), trajectories, duration=2.0, rate=15.0)
        x = cloth(state, trajectories, t.tolist()).x.numpy()
    # measured where the vertices are: distances vanish with the true values only
    return rec.Recording(
        cloth=replace(info, initial_vertices=x[0]),
        provenance="synthetic: tests",
        grasps={name: rec.GraspInfo(twins.jaw_points(name), twins.GRASP_RADIUS_M) for name in twins.GRASPED_EDGES_U_M},
        grippers=drive,
        points=rec.PointClouds(t, x.reshape(-1, 3), np.full(3, x.shape[1])),
        air_density=1.204,
        split={"motion": motion},
    )


@pytest.fixture(scope="session")
def episodes(tmp_path_factory) -> Path:
    """Folder with ep_0, ep_1, ep_2 (motion "shake") and held (motion "other")."""
    folder = tmp_path_factory.mktemp("episodes")
    with twins.use_float64():
        for i, amplitude in enumerate((0.06, 0.1, 0.14)):
            rec.write(tiny(amplitude), folder / f"ep_{i}")
        rec.write(tiny(0.08, "other"), folder / "held")
    return folder


@pytest.fixture
def config(episodes, tmp_path):
    """Writes a config with some sections replaced; returns its path."""

    def write(**sections) -> str:
        content = {
            "out": str(tmp_path / "out"),
            "data": {"train": str(episodes / "ep_*")},
            "learn": {"parameters": ["youngs_modulus", "air.normal"]},
            "loss": {"points": 1e-3},
            "optimizer": {"steps": 3},
            "run": {"loggers": []},
        }
        path = tmp_path / "config.yaml"
        path.write_text(yaml.safe_dump(content | sections))
        return str(path)

    return write
