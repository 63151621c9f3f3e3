"""Small films whose every number is known, and the shipped episode with a fit written by hand."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import torchcloth
from torchcloth import meshes, recordings
from torchcloth.errors import MissingDependency
from torchcloth.identification.result import IDENTIFICATION_SCHEMA
from torchcloth.observe.render import import_open3d
from torchcloth.viewing import ClothSurface, Cloud, Curve, Film, GripperPath, GroundPlane, RigidBody

EXAMPLE = Path(torchcloth.__file__).parent / "examples" / "bimanual_swing"
FRAMES = 6
# What `torchcloth identify` found on the shipped episode; distances of its first frames follow from these values.
VALUES = {
    "youngs_modulus": 51294.0,
    "poisson_ratio": 0.0665,
    "contact_stiffness": 1e6,
    "shear_stiffness": 2.5e5,
    "cone": 0.3,
    "areal_density": 0.35009,
    "bending.stiffness": 3.461e-5,
    "bending.damping_time": 0.005,
    "air.normal": 1.205,
    "air.tangential": 0.0,
}


@pytest.fixture
def film() -> Film:
    """A sheet of 0.4 m that rises, with points 1 mm above it, a ball, a table and a gripper; six frames in 0.5 s."""
    times = np.linspace(1.0, 1.5, FRAMES)
    mesh = meshes.rectangle(0.4, 0.4, triangles=72)
    flat = np.column_stack([mesh.uv - 0.2, np.zeros(len(mesh.vertices))])
    lift = np.linspace(0.0, 0.1, FRAMES)
    x = flat + lift[:, None, None] * np.array([0.0, 0, 1])
    rng = np.random.default_rng(0)
    on = rng.uniform(-0.15, 0.15, (FRAMES, 40, 2))
    points = tuple(
        np.column_stack([p, np.full(40, z + 1e-3)]).astype(np.float32) for p, z in zip(on, lift, strict=True)
    )
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    poses[:, 2, 3] = 0.2 + lift
    ball = torchcloth.observe.build_solid_mesh("sphere", (0.03,), np.eye(4))
    corner = 0.6 * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    return Film(
        title="known",
        times=times,
        sheets={"cloth": ClothSurface(x.astype(np.float32), mesh.faces)},
        clouds={"points": Cloud(points)},
        solids={"arms/one/ball": RigidBody(*ball, poses, (255, 0, 0))},
        planes={"colliders/table": GroundPlane(corner - [0, 0, 0.05])},
        traces={"grippers/one": GripperPath(poses[:, :3, 3], poses)},
        curves={"force/one": Curve(np.linspace(1.0, 1.5, 11), np.arange(11.0), "N")},
    )


@pytest.fixture(scope="session")
def needs_open3d():
    try:
        import_open3d()
    except MissingDependency as error:
        pytest.skip(str(error))


@pytest.fixture(scope="session")
def example():
    """The shipped episode's first frames, on disk."""
    return recordings.read(EXAMPLE, with_truth=True)


@pytest.fixture(scope="session")
def short(tmp_path_factory, example):
    """(folder of the shipped episode's first six frames, identification.json written for it by hand)."""
    folder = tmp_path_factory.mktemp("short") / "swing"
    points = example.points
    count = int(points.counts[:FRAMES].sum())
    cut = recordings.PointClouds(points.t[:FRAMES], points.xyz[:count], points.counts[:FRAMES])
    recordings.write(recordings.Recording(**{**vars(example), "points": cut}), folder)
    xyz = recordings.read(folder).points.xyz
    mark = {"name": "swing", "frames": FRAMES, "points": len(xyz), "mean": xyz.mean(0).tolist(), "chamfer": 0.001}
    fit = folder.parent / "identification.json"
    model = {"values": VALUES, "thickness": None, "contact": None, "dt": None, "episodes": [mark]}
    model["unrecorded_settings"] = []
    message = {"youngs_modulus": {"initial": 5e4, "value": 51294.0, "std": 100.0, "source": "data"}}
    result = {
        "schema": IDENTIFICATION_SCHEMA,
        "parameters": message,
        "correlation": {name: {name: 1.0} for name in message},
        "fit": {"rms_after": 0.0012},
    }
    fit.write_text(json.dumps({**result, "model": model}))
    return folder, fit


@pytest.fixture
def spoiled(short, tmp_path):
    """A copy of the fit to break: (episode, path, content)."""
    folder, fit = short
    path = Path(shutil.copy(fit, tmp_path / "identification.json"))
    return folder, path, json.loads(path.read_text())
