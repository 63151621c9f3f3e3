"""Write a bench as a stranger has it: joint angles in CSV, depth images in PNG with stamps, intrinsics, camera's pose.

The images are rendered with the cloth, the arms, what holds the cloth, a table, a floor and a wall, and have the noise
and the bias of their camera. The Kinect's bench logs radians and seconds of the epoch, and names each image by its
stamp in ns. The bench of the stereo camera logs degrees and milliseconds without a header, and a table has the stamps.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from torchcloth import observe

from .camera_room import Mesh, build_room, make_camera_noise, place_camera, shrink_camera
from .flex_sheet import sheet_mesh
from .stranger_bench import ARM_MODEL, ARM_TOOL, ONE_ARM_NAME, StrangerBench

Array = np.ndarray
MAX_AZIMUTH_RAD = 0.6  # of the camera, off the normal of the cloth
EPOCH_NS = 1_714_000_000_123_456_789  # stamp of the first joints of a Kinect's bench
START_S = 3.25  # likewise of a bench that counts from the start of its computer's program
ROD_RADIUS_M, ROD_OVERHANG_M = 3e-3, 0.01  # of the bar in the hem of the cloth


def write_bench(bench: StrangerBench, folder: Path) -> None:
    """Write the files of a bench into a new folder; ``command.txt`` has the arguments of ``torchcloth new``."""
    rng = np.random.default_rng([bench.seed, 78])
    full = place_camera(rng, bench.camera, bench.x, MAX_AZIMUTH_RAD)
    camera = shrink_camera(full, bench.size.shrink)
    folder.mkdir(parents=True)
    is_kinect = bench.camera == "kinect"
    _write_images(folder, bench, _take_images(rng, bench, full), is_kinect)
    for name, q in bench.joints.items():
        _write_joints(folder / f"{name}.csv", bench.joint_times, q, is_kinect)
        if len(bench.joints) > 1:
            np.savetxt(folder / f"{name}_base.txt", bench.rig[name].base.numpy())
    _write_camera(folder, camera, bench.believed_from_true @ camera.T_world_camera, is_kinect)
    (folder / "command.txt").write_text(" ".join(list_options(bench)) + "\n")


def list_options(bench: StrangerBench) -> list[str]:
    """Return the arguments of ``torchcloth new`` but the episode, with files by their names in the folder."""
    options = ["--urdf", ARM_MODEL, "--tool", ARM_TOOL]
    for name, place in bench.places.items():
        options += ["--joints", f"{name}.csv", "--held", *(f"{value:g}" for value in place)]
        if name != ONE_ARM_NAME:
            options += ["--base", f"{name}_base.txt", "--name", name]
    options += ["--bar"] if bench.holding == "bar" else []
    options += ["--sheet", f"{bench.sheet.width:g}", f"{bench.sheet.height:g}", "--mass", f"{bench.mass:.4f}"]
    options += ["--depth", "depth", "--intrinsics", "K.json", "--camera-pose", "camera.txt"]
    return [*options, "--motion", bench.motion]


def _take_images(rng: np.random.Generator, bench: StrangerBench, camera: observe.DepthCamera) -> list[Array]:
    """Return the depth images [H, W] m, of which every ``shrink``-th row and column is stored."""
    view = observe.View(camera, make_camera_noise(bench.camera)).with_bias(rng)
    assert view.noise is not None
    assert bench.rig.table is not None
    faces = sheet_mesh(bench.sheet)[1]
    q = {
        name: torch.tensor(np.stack([np.interp(bench.light_times, bench.joint_times, angle) for angle in joint.T], 1))
        for name, joint in bench.joints.items()
    }
    solids = bench.rig.geometry(q)
    still = [*observe.build_solid_meshes([bench.rig.table.primitive()]), *build_room()]
    images, last_time = [], np.nan
    for k, time in enumerate(bench.light_times):
        if time != last_time:  # a frozen camera sends its last image again
            bodies = [(bench.x[k], faces), *observe.build_solid_meshes(solids, at=k), *still, *_rods(bench, k)]
            depth, _ = observe.render_depth(camera, bodies)
            image = view.noise.apply(depth, rng, view.bias)[:: bench.size.shrink, :: bench.size.shrink]
        images.append(image)
        last_time = time
    return images


def _rods(bench: StrangerBench, image: int) -> list[Mesh]:
    """Return the rod in the hem of a sheet on a bar."""
    if bench.holding != "bar":
        return []
    pose = bench.hold[ONE_ARM_NAME][image].copy()
    pose[:3, :3] = pose[:3, :3] @ Rotation.from_euler("x", 90, degrees=True).as_matrix()
    length = bench.sheet.width + 2 * ROD_OVERHANG_M
    return [observe.build_solid_mesh("cylinder", (ROD_RADIUS_M, length), pose)]


def _write_images(folder: Path, bench: StrangerBench, images: list[Array], is_kinect: bool) -> None:
    first = bench.joint_times[0]
    (folder / "depth").mkdir()
    names = [f"{k:06d}" for k in range(len(images))]
    if is_kinect:
        names = [str(EPOCH_NS + round(1e9 * (stamp - first))) for stamp in bench.stamps]
    else:
        rows = [f"{k},{START_S + stamp - first:.6f}" for k, stamp in enumerate(bench.stamps)]
        (folder / "depth" / "timestamps.csv").write_text("\n".join(["frame,time", *rows]) + "\n")
    for name, image in zip(names, images, strict=True):
        Image.fromarray(observe.encode_depth(image)).save(folder / "depth" / f"{name}.png")


def _write_joints(path: Path, t: Array, q: Array, is_kinect: bool) -> None:
    since_start = t - t[0]
    if not is_kinect:
        rows = np.column_stack([1e3 * (START_S + since_start), np.degrees(q)])
        np.savetxt(path, rows, fmt=["%.3f", *["%.6f"] * q.shape[1]], delimiter=",")
        return
    stamps = [EPOCH_NS + round(1e9 * seconds) for seconds in since_start]
    rows = [
        ",".join([f"{ns // 10**9}.{ns % 10**9:09d}", *(f"{angle:.8f}" for angle in angles)])
        for ns, angles in zip(stamps, q, strict=True)
    ]
    header = ",".join(["timestamp", *(f"q{k + 1}" for k in range(q.shape[1]))])
    path.write_text("\n".join([header, *rows]) + "\n")


def _write_camera(folder: Path, camera: observe.DepthCamera, pose: Array, is_kinect: bool) -> None:
    """Write the matrix as a CameraInfo of ROS and the stated pose: 4 x 4 numbers, or position and quaternion."""
    size = {"width": camera.width, "height": camera.height, "k": camera.K.ravel().tolist()}
    model, lens = ("rational_polynomial", camera.distortion.tolist()) if is_kinect else ("plumb_bob", [0.0] * 5)
    (folder / "K.json").write_text(json.dumps({**size, "d": lens, "distortion_model": model}) + "\n")
    if is_kinect:
        np.savetxt(folder / "camera.txt", pose, fmt="%.9f")
        return
    words = [*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()]
    (folder / "camera.txt").write_text(" ".join(f"{word:.9f}" for word in words) + "\n")
