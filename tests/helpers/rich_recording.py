"""One rich synthetic episode that uses every part of the format, and a comparison of recordings."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from torchcloth import recordings as rec


def check_equal(a, b, *, atol: float = 0.0, times: float = 0.0, at: str = "recording") -> None:
    """Check that two recordings are equal field by field.

    Args:
        a: a recording or a part of one.
        b: likewise.
        atol: m, for points.
        times: s, tolerance of times.
        at: name of the part, for messages. Paths may differ, image bytes may not.
    """
    if is_dataclass(a):
        assert type(a) is type(b), at
        for f in fields(a):
            check_equal(getattr(a, f.name), getattr(b, f.name), atol=atol, times=times, at=f"{at}.{f.name}")
    elif isinstance(a, np.ndarray):
        assert a.dtype == b.dtype, at
        allowed = {"xyz": atol if at.endswith("points.xyz") else 0.0, "t": times}.get(at.rpartition(".")[2], 0.0)
        np.testing.assert_allclose(a, b, rtol=0, atol=allowed, err_msg=at)
    elif isinstance(a, dict):
        assert a.keys() == b.keys(), at
        for key in a:
            check_equal(a[key], b[key], atol=atol, times=times, at=f"{at}.{key}")
    elif isinstance(a, tuple) and a and isinstance(a[0], Path):
        assert [p.read_bytes() for p in a] == [p.read_bytes() for p in b], at
    elif not at.endswith(".path"):
        assert a == b, at


def make_transform(x: float) -> np.ndarray:
    c, s = np.cos(0.7), np.sin(0.7)
    return np.array([[c, -s, 0, x], [s, c, 0, 0.1], [0, 0, 1, 0.2], [0, 0, 0, 1]], dtype=float)


def make_images(folder: Path) -> dict[str, rec.ImageStream]:
    folder.mkdir()
    rng = np.random.default_rng(1)
    made = {
        "depth": rng.integers(0, 60_000, (2, 6, 8), dtype=np.uint16),
        "color": rng.integers(0, 255, (2, 6, 8, 3), dtype=np.uint8),
        "mask": rng.integers(0, 2, (2, 6, 8), dtype=np.uint8) * np.uint8(255),
    }
    streams = {}
    for kind, stack in made.items():
        paths = tuple(folder / f"{kind}{i}.{'jpg' if kind == 'color' else 'png'}" for i in range(len(stack)))
        for pixels, path in zip(stack, paths, strict=True):
            Image.fromarray(pixels).save(path)
        t = np.array([0.1, 0.2]) + (0.005 if kind == "color" else 0.0)
        streams[kind] = rec.ImageStream(kind, np.array([0, 3]), t, paths, (8, 6))  # type: ignore[arg-type]
    return streams


def make_cloth(rng: np.random.Generator) -> rec.ClothInfo:
    uv = np.stack(np.meshgrid(np.linspace(0, 0.3, 4), np.linspace(0, 0.2, 3), indexing="ij"), axis=-1).reshape(-1, 2)
    cells = [(i * 3 + j, (i + 1) * 3 + j, (i + 1) * 3 + j + 1, i * 3 + j + 1) for i in range(3) for j in range(2)]
    faces = np.array([triangle for a, b, c, d in cells for triangle in ((a, b, c), (a, c, d))])
    vertices = np.concatenate([uv, np.zeros((12, 1))], axis=1)
    return rec.ClothInfo(
        areal_density=0.15,
        areal_density_std=0.005,
        thickness=5e-4,
        sheet=(0.3, 0.2),
        vertices=vertices,
        faces=faces,
        uv=uv,
        initial_vertices=vertices + rng.normal(0, 1e-3, vertices.shape),
        nominal={"membrane_stiffness": 600, "units": {"membrane_stiffness": "N/m"}},
        extra={"weave": "twill", "sheet": {"measured_by": "ruler"}},
    )


def make_recording(tmp: Path) -> rec.Recording:
    rng = np.random.default_rng(0)
    t, knots = np.linspace(0, 1, 6), 6
    quat = rng.normal(size=(knots, 4))
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    closed, force = np.array([1, 1, 1, 1, 0, 0], dtype=bool), rng.normal(size=(knots, 3))
    counts = np.array([30, 1, 17])
    markers = rng.normal(0, 0.1, (4, 2, 3))
    markers[1, 0] = np.nan
    images = make_images(tmp / "images")
    cloth = make_cloth(rng)
    return rec.Recording(
        cloth=cloth,
        provenance="synthetic: conftest",
        grasps={
            "left": rec.GraspInfo(np.array([[0.0, 0.0]]), 0.012, {"pad": "rubber"}),
            "right": rec.GraspInfo(np.array([[0.3, 0.0], [0.305, 0.2]]), 0.012),
        },
        grippers={
            "left": rec.GripperMotion(t, rng.normal(0, 0.2, (knots, 3)), quat, closed, force, extra={"note": t**2}),
            "right": rec.GripperMotion(t, rng.normal(0, 0.2, (knots, 3)), quat, closed, force, -force),
        },
        joints={
            "right": rec.JointMotion(t, rng.normal(size=(knots, 7)), closed, t * 0.05, force, -force),
            "spare": rec.JointMotion(t[:3], rng.normal(size=(3, 6)), width=t[:3] * 0.05),
        },
        robots={
            "right": rec.RobotInfo("rizon4", make_transform(0.5), "tcp_closed", {"serial": "A7"}),
            "spare": rec.RobotInfo("homemade", make_transform(-0.5)),
        },
        cameras={
            "cam0": rec.Camera(
                width=8,
                height=6,
                K=np.array([[500.0, 0, 4], [0, 501, 3], [0, 0, 1]]),
                T_world_camera=make_transform(1.0),
                distortion=np.array([0.1, -0.2, 1e-3, 2e-3]),
                depth_scale=0.001,
                **images,
                extra={"serial": 12},
            ),
            "cam1": rec.Camera(width=8, height=6, K=np.eye(3), T_world_camera=np.eye(4)),
        },
        colliders={
            "table": rec.Collider(np.zeros(3), np.array([0.0, 0, 1]), 0.4, {"plane": {"size": 2}, "wood": True})
        },
        points=rec.PointClouds(
            np.array([0.1, 0.2, 0.3]), rng.normal(0, 0.2, (48, 3)), counts, {"sensor": np.arange(3)}
        ),
        markers=rec.Markers(np.array([0.1, 0.2, 0.3, 0.4]), markers, np.array([[0.0, 0.0], [0.3, 0.2]])),
        truth=rec.Truth(t, rng.normal(0, 0.2, (knots, 12, 3)), cloth.faces),  # type: ignore[arg-type]
        observation_noise_std=0.002,
        clock_offset=0.01,
        gravity=np.array([0, 0, -9.80]),
        air_density=1.204,
        split={"motion": "slow_swing", "replicate_of": "ep_02", "fold": 3},
        licence="CC0",
        extra={"operator": "K", "nothing": None, "observation_noise": {"model": "kinect"}, "air": {"humidity": 0.4}},
    )
