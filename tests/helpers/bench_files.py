"""The files of a stranger's bench: joint angles in CSV, rendered depth images in PNG, and a calibration."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

import torchcloth as tc
from torchcloth import observe, recordings, robots

EXAMPLE = Path(tc.__file__).with_name("examples") / "bimanual_swing"
IMAGE_SCALE = 0.2  # of the camera's resolution
FRAME_PERIOD_S = 0.16
DEPTH_NOISE_M = 1e-3
FIRST_STAMP_NS = 1_714_000_000_123_456_789
CAMERA_FIRST_STAMP_NS = 7_654_321_000  # of a camera that counts from its start
HANDS = ("left", "right")
BAR_SHEET_M = (0.3, 0.25)


@dataclass(frozen=True)
class Bench:
    """A bench on disk.

    Attributes:
        options: of ``torchcloth new``.
        source: the recording whose joints, arms and grasps these are.
        times: [T] s, of the images on the clock of the joints.
        x: [T, V, 3] m, true vertices.
        faces: [F, 3].
    """

    options: list[str]
    source: recordings.Recording
    times: np.ndarray
    x: np.ndarray
    faces: np.ndarray


def write_two_arms(folder: Path) -> Bench:
    """Write the shipped swing of two arms, simulated by MuJoCo.

    The joints have a header and epoch stamps in s. The stamps of the images are in their names, in ns of a clock of the
    camera. The camera's pose is given as world to camera.
    """
    source = recordings.read(EXAMPLE, with_truth=True)
    frames = np.arange(0, len(source.truth.t), round(FRAME_PERIOD_S / np.diff(source.truth.t)[0]))
    times, x = source.truth.t[frames], source.truth.vertices[frames]
    options = ["--urdf", "rizon4", "--tool", "tcp_closed", "--sheet", "0.4", "0.4", "--grip-radius", "0.026"]
    folder.mkdir()
    for name in HANDS:
        joints = source.joints[name]
        stamps = [
            f"{ns // 10**9}.{ns % 10**9:09d}" for ns in (FIRST_STAMP_NS + np.round(1e9 * joints.t).astype(int)).tolist()
        ]
        rows = [",".join([t, *map(repr, q), "1"]) for t, q in zip(stamps, joints.q.tolist(), strict=True)]
        heads = ",".join(["timestamp", *(f"q{k}" for k in range(7)), "closed"])
        (folder / f"{name}.csv").write_text("\n".join([heads, *rows]) + "\n")
        np.savetxt(folder / f"{name}_base.txt", source.robots[name].T_world_base)
        options += ["--joints", f"{folder}/{name}.csv", "--base", f"{folder}/{name}_base.txt", "--name", name]
        options += ["--held", *map(str, source.grasps[name].uv[0])]
    names = [str(CAMERA_FIRST_STAMP_NS + round(1e9 * t)) for t in times]
    camera = _write_images(folder, source, times, x, source.truth.faces, HANDS, names)
    np.savetxt(folder / "camera.txt", np.linalg.inv(camera.T_world_camera))
    intrinsics = dict(zip(("fx", "fy", "cx", "cy"), camera.K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(), strict=True))
    (folder / "K.json").write_text(json.dumps(intrinsics))
    return Bench([*options, *_camera_options(folder)], source, times, x, source.truth.faces)


def write_bar(folder: Path) -> Bench:
    """Write a flat sheet that one arm carries by a bar, as if it were a board.

    The joints have no header, and are in ms and degrees. The images are numbered, and their times stand in a table
    beside them. The camera's pose is position and quaternion, its matrix a CameraInfo.
    """
    source = recordings.read(EXAMPLE)
    joints = source.joints["left"]
    folder.mkdir()
    rows = np.column_stack([1e3 * joints.t, np.degrees(joints.q)])
    np.savetxt(folder / "joints.csv", rows, fmt="%.12g", delimiter=";")
    np.savetxt(folder / "base.txt", source.robots["left"].T_world_base)
    times = np.arange(joints.t[0], joints.t[-1], FRAME_PERIOD_S)
    mesh = tc.meshes.rectangle(*BAR_SHEET_M, triangles=72)
    u, v = mesh.uv.T
    hanging = np.stack([0 * u, u - BAR_SHEET_M[0] / 2, v - BAR_SHEET_M[1]], 1)
    x = hanging + np.array([_tool(source, t)[:3, 3] for t in times])[:, None]
    camera = _write_images(folder, source, times, x, mesh.faces, ("left",), [f"{k:06d}" for k in range(len(times))])
    np.savetxt(folder / "depth_times.csv", times, header="t_depth", comments="")
    pose = camera.T_world_camera
    words = [*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()]
    (folder / "camera.txt").write_text(" ".join(map(repr, map(float, words))))
    info = {"width": camera.width, "height": camera.height, "k": camera.K.ravel().tolist(), "d": [0.0] * 5}
    (folder / "K.json").write_text(json.dumps({**info, "distortion_model": "plumb_bob"}))
    options = ["--urdf", "rizon4", "--tool", "tcp_closed", "--joints", f"{folder}/joints.csv"]
    options += ["--base", f"{folder}/base.txt", "--held", str(BAR_SHEET_M[0] / 2), str(BAR_SHEET_M[1]), "--bar"]
    options += ["--sheet", *map(str, BAR_SHEET_M), "--mass", "0.02", *_camera_options(folder)]
    return Bench(options, source, times, x, mesh.faces)


def _camera_options(folder: Path) -> list[str]:
    names = {"--depth": "depth", "--intrinsics": "K.json", "--camera-pose": "camera.txt"}
    return [word for option, name in names.items() for word in (option, f"{folder}/{name}")]


def _tool(source: recordings.Recording, time: float, name: str = "left") -> np.ndarray:
    return robots.arm_from_recording(source, name)(_joints(source, time, name)).numpy()


def _joints(source: recordings.Recording, time: float, name: str) -> torch.Tensor:
    joints = source.joints[name]
    return torch.tensor([np.interp(time, joints.t, angle) for angle in joints.q.T])


def _write_images(
    folder: Path,
    source: recordings.Recording,
    times: np.ndarray,
    x: np.ndarray,
    faces: np.ndarray,
    hands: tuple[str, ...],
    names: list[str],
) -> observe.DepthCamera:
    """Write images of the cloth and of some arms, in mm, and return the camera."""
    camera = observe.DepthCamera.from_recording(source.cameras["cam0"])
    K = camera.K * np.array([[IMAGE_SCALE], [IMAGE_SCALE], [1.0]])
    camera = replace(camera, width=round(IMAGE_SCALE * camera.width), height=round(IMAGE_SCALE * camera.height), K=K)
    arms = {name: robots.arm_from_recording(source, name) for name in hands}
    rng = np.random.default_rng(0)
    (folder / "depth").mkdir()
    for time, vertices, name in zip(times, x, names, strict=True):
        solids = [p for hand, arm in arms.items() for p in arm.geometry(_joints(source, time, hand))]
        depth = observe.render_depth(camera, [(vertices, faces), *observe.build_solid_meshes(solids)])[0]
        noisy = np.where(depth > 0, depth + DEPTH_NOISE_M * rng.standard_normal(depth.shape), 0.0)
        Image.fromarray(observe.encode_depth(noisy)).save(folder / "depth" / f"{name}.png")
    return camera
