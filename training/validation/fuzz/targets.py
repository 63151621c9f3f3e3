"""One target for each format: read a file, and check what was read."""

from __future__ import annotations

import atexit
import json
import os
import shutil
import tempfile
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchcloth import meshes
from torchcloth import recordings as rec
from torchcloth.diagnosis.models.model_file import read_model
from torchcloth.errors import RecordingError
from torchcloth.meshes import obj
from torchcloth.recordings import formats, reading, streams
from torchcloth.recordings.files import Folder
from torchcloth.recordings.formats.calibration_files import read_intrinsics, read_pose
from torchcloth.recordings.formats.joint_log import JointNames, read_joint_log
from torchcloth.recordings.formats.ros2_topics import SCENE_TOPIC
from torchcloth.recordings.images import import_pillow
from torchcloth.robots import load as load_arm  # pyright: ignore[reportMissingImports] - mapped from robots/
from torchcloth.schemas import check_structure

from . import invariants, mutations
from .formats import register_format
from .invariants import require

MEMORY_FOLDER = Path("/dev/shm")  # a file system in memory, where there is one
TOOL_FRAME = "tool"  # the last link of the seeds
CHECKED_ANGLE_RAD = 0.3  # of every joint
READING = "torchcloth.recordings"
PART_SEPARATOR = b"\n====\n"  # between the files of an input that stands for several
BENCH_JOINTS = "j1", "j2"
TUM_IMAGE_NAMES = ("1.png", "2.png")
# What each topic of the seeds is.
BAG_SCENE = {
    "provenance": "measured",
    "cloth": {"sheet": {"width": 0.3, "height": 0.2}, "areal_density": 0.15},
    "grasps": {"left": {"uv": [[0.0, 0.0]], "radius": 0.01}},
    "cameras": {"cam0": {"T_world_camera": np.eye(4).tolist()}},
    "source": {
        "motion": {
            "left": {"pose": "/pose", "closed": "/closed", "wrench": "/wrench", "wrench_frame": "gripper"},
            "arm": {"joints": {"topic": "/joints", "names": ["j1", "j2"], "width": "finger"}, "closed": True},
        },
        "points": {"topic": "/cloud"},
        "cameras": {"cam0": {"depth": "/depth", "info": "/info"}},
    },
}


@cache
def scratch_folder() -> Path:
    """Return a folder in memory, which is removed when the process ends."""
    folder = Path(tempfile.mkdtemp(prefix="fuzz-", dir=MEMORY_FOLDER if MEMORY_FOLDER.is_dir() else None))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def write_input(name: str, data: bytes) -> Path:
    """Write an input under this name, for readers that take a path."""
    path = scratch_folder() / f"{os.getpid()}-{name}"
    path.write_bytes(data)
    return path


@register_format("obj", mutations.mutate_text, "torchcloth.meshes")
def read_obj(data: bytes) -> None:
    """Read a mesh in OBJ; it reads the same when it was written again."""
    mesh = meshes.load(write_input("mesh.obj", data))
    invariants.check_mesh(mesh)
    vertices, faces, corners = obj.parse(obj.dump(mesh.vertices, mesh.faces, mesh.pattern), "copy")
    require(np.array_equal(vertices, mesh.vertices) and np.array_equal(faces, mesh.faces), "the copy is the mesh")
    is_same = corners is None if mesh.pattern is None else np.array_equal(corners, mesh.pattern)  # type: ignore[arg-type]
    require(is_same, "the copy has the mesh's pattern")


@register_format("ply", mutations.mutate_text, "torchcloth.meshes", "trimesh.exchange.ply")
def read_ply(data: bytes) -> None:
    """Read a mesh in PLY."""
    invariants.check_mesh(meshes.load(write_input("mesh.ply", data)))


class LoadedFolder(Folder):
    """A folder in which every archive has the same arrays, which were read before.

    Args:
        arrays: of the archives.
    """

    def __init__(self, arrays: dict[str, np.ndarray]) -> None:
        super().__init__(scratch_folder())
        self.arrays = arrays

    def read_npz(self, name: str) -> dict[str, np.ndarray]:
        """Return the arrays that were read before."""
        return self.arrays


@register_format("npz", mutations.mutate_zip, READING, "numpy.lib._format_impl")
def read_npz(data: bytes) -> None:
    """Read the bytes as each of the archives of an episode; one of them is enough."""
    name = streams.POINTS_FILE
    folder = LoadedFolder(Folder(scratch_folder(), in_memory={name: data}).read_npz(name))
    readers = _check_motion_file, _check_points_file, _check_markers_file, _check_truth_file
    refusals = []
    for check in readers:
        try:
            check(folder)
        except RecordingError as error:
            refusals.append(error)
    if len(refusals) == len(readers):
        raise refusals[0]


def _check_motion_file(folder: Folder) -> None:
    grippers, joints = streams.parse_motions(streams.read_motion_groups(folder), "file")
    cloth = rec.ClothInfo(areal_density=1.0, sheet=(1.0, 1.0))
    invariants.check_recording(rec.Recording(cloth=cloth, provenance="measured", grippers=grippers, joints=joints))


def _check_points_file(folder: Folder) -> None:
    invariants.check_points(streams.parse_points(folder.read_npz(streams.POINTS_FILE), "file"))


def _check_markers_file(folder: Folder) -> None:
    invariants.check_markers(streams.read_markers(folder))


def _check_truth_file(folder: Folder) -> None:
    invariants.check_truth(streams.read_truth(folder))


class PreparedFolder(Folder):
    """An episode folder whose arrays were read before; only episode.json is new.

    Args:
        path: the folder of the other files.
        content: of episode.json.
    """

    def __init__(self, path: Path, content: bytes) -> None:
        super().__init__(path, in_memory={reading.EPISODE_FILE: content})

    def read_npz(self, name: str) -> dict[str, np.ndarray]:
        """Return the arrays of an archive."""
        return _read_prepared_npz(name)


@cache
def _read_prepared_npz(name: str) -> dict[str, np.ndarray]:
    return Folder(prepared_episode()).read_npz(name)


@cache
def prepared_episode() -> Path:
    """Return an episode folder with every stream but images, whose episode.json is the seed."""
    sheet = meshes.rectangle(0.3, 0.2, resolution=(3, 3))
    t, closed = np.array([0.0, 0.5, 1.0]), np.array([True, True, False])
    quaternions = np.tile([1.0, 0.0, 0.0, 0.0], (3, 1))
    recording = rec.Recording(
        cloth=rec.ClothInfo(
            areal_density=0.15,
            areal_density_std=0.005,
            thickness=5e-4,
            sheet=(0.3, 0.2),
            vertices=sheet.vertices,
            faces=sheet.faces,
            uv=sheet.uv,
            initial_vertices=sheet.vertices,
            nominal={"membrane_stiffness": 600.0, "poisson_ratio": 0.3, "bending_stiffness": 3e-5},
        ),
        provenance="synthetic: fuzzing",
        grasps={
            "left": rec.GraspInfo(np.array([[0.0, 0.0]]), 0.01),
            "right": rec.GraspInfo(vertices=np.array([2, 3])),
        },
        grippers={"left": rec.GripperMotion(t, np.zeros((3, 3)), quaternions, closed)},
        joints={"right": rec.JointMotion(t, np.zeros((3, 7)), closed, np.array([0.05, 0.02, 0.0]))},
        robots={"right": rec.RobotInfo("rizon4", np.eye(4), "tcp_closed")},
        cameras={
            "cam0": rec.Camera(
                width=640,
                height=480,
                K=np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]),
                T_world_camera=np.eye(4),
                distortion=np.array([0.1, -0.2, 1e-3, 2e-3]),
                depth_scale=0.001,
            )
        },
        colliders={"table": rec.Collider(np.zeros(3), np.array([0.0, 0.0, 1.0]), 0.4)},
        points=rec.PointClouds(t, np.zeros((6, 3)), np.array([2, 2, 2])),
        markers=rec.Markers(t, np.zeros((3, 2, 3)), np.array([[0.0, 0.0], [0.3, 0.2]])),
        observation_noise_std=0.002,
        clock_offset=0.01,
        air_density=1.2,
        split={"motion": "slow", "replicate_of": "ep_02"},
        licence="CC0",
    )
    return rec.write(recording, scratch_folder() / "episode")


@register_format("episode", mutations.mutate_json, READING)
def read_episode(data: bytes) -> None:
    """Read episode.json beside files that fit it; what the reader accepts follows the schema."""
    folder = PreparedFolder(prepared_episode(), data)
    invariants.check_recording(reading.read_folder(folder, with_truth=True))
    try:
        check_structure(json.loads(data.decode("utf-8-sig")), "episode")
    except ValueError as error:
        require(False, f"what is accepted follows the schema: {error}")


@register_format("urdf", mutations.mutate_text, "torchcloth.robots", "pytorch_kinematics.urdf_parser_py")
def read_urdf(data: bytes) -> None:
    """Read an arm, and compute its pose."""
    arm = load_arm(write_input("arm.urdf", data), frame=TOOL_FRAME)
    limits = arm.limits
    require(len(set(arm.joint_names)) == len(arm.joint_names) > 0, "joints have names of their own")
    require((limits.lower <= limits.upper).all(), "lower limits are below the upper ones")
    require((limits.soft_lower <= limits.soft_upper).all(), "soft lower limits are below the upper ones")
    require((limits.velocity > 0).all() and not torch.stack(list(limits)).isnan().any(), "limits are numbers")
    invariants.check_unit(arm.axis.numpy(), "axes of joints")
    q = torch.full((len(arm.joint_names),), CHECKED_ANGLE_RAD, dtype=torch.float64)
    for primitive in arm.geometry(q):
        require(all(0 < size < np.inf for size in primitive.size), "solids have sizes")
        invariants.check_rigid(primitive.pose.numpy(), "pose of a solid")
    invariants.check_rigid(arm(q).numpy(), "pose of the tool")


@register_format("tcm", mutations.mutate_zip, READING, "torchcloth.diagnosis.models", "torchcloth.meshes")
def read_tcm(data: bytes) -> None:
    """Read a model of ``diagnose``, and build its world."""
    file = read_model(write_input("model.tcm", data))
    model = file.model
    require(model.coordinates.isfinite().all(), "coordinates are finite")
    invariants.check_finite((parameter.name, parameter.value(float(x))) for parameter, x in _parameters(model))
    invariants.check_finite([("amplitudes", np.array(model.amplitudes)), ("gravity", file.scene.gravity)])
    invariants.check_cloth(file.scene.cloth)
    if file.covariance is not None:
        size = len(model.parameters) + len(model.accepted)
        require(len(model.coordinates) == len(model.parameters), "every parameter has a coordinate")
        require(file.covariance.shape[0] == file.covariance.shape[1] <= size, "the covariance fits the numbers")
        require(file.covariance.isfinite().all() and (file.covariance.diagonal() >= 0).all(), "variances are variances")


def _parameters(model: Any) -> Any:
    return zip(model.parameters, model.coordinates, strict=True)


def _read_bag(name: str, data: bytes) -> None:
    scene = scratch_folder() / "scene.json"
    if not scene.exists():
        scene.write_text(json.dumps(BAG_SCENE))
    has_own_scene = SCENE_TOPIC.encode() in data
    invariants.check_recording(formats.read(write_input(name, data), scene=None if has_own_scene else scene))


@register_format("mcap", mutations.mutate_mcap, READING, "rosbags.rosbag2", "rosbags.serde")
def read_mcap(data: bytes) -> None:
    """Read a bag of ROS 2 in one MCAP file."""
    _read_bag("bag.mcap", data)


@register_format("sqlite", mutations.mutate_sqlite, READING, "rosbags.rosbag2", "rosbags.serde")
def read_sqlite(data: bytes) -> None:
    """Read a bag of ROS 2 in one sqlite file."""
    _read_bag("bag.db3", data)


@register_format("rosbag1", mutations.mutate_in_place, READING, "rosbags.rosbag1", "rosbags.serde")
def read_rosbag1(data: bytes) -> None:
    """Read a bag of ROS 1."""
    _read_bag("bag.bag", data)


def write_parts(folder: Path, names: Sequence[str], data: bytes) -> None:
    """Write the parts of an input, between lines of equals signs, into the text files of a folder."""
    parts = data.split(PART_SEPARATOR)
    for i, name in enumerate(names):
        (folder / name).write_bytes(parts[i] if i < len(parts) else b"")


@cache
def prepared_tum_folder() -> Path:
    """Return a TUM folder with its images and scene, and without its lists."""
    folder, Image = scratch_folder() / "tum", import_pillow()
    for kind, dtype in (("rgb", np.uint8), ("depth", np.uint16)):
        (folder / kind).mkdir(parents=True)
        for name in TUM_IMAGE_NAMES:
            shape = (3, 4, 3) if kind == "rgb" else (3, 4)
            Image.fromarray(np.full(shape, 5000 if kind == "depth" else 100, dtype)).save(folder / kind / name)
    camera = {"K": [[5.0, 0, 2], [0, 5, 1.5], [0, 0, 1]], "depth_scale": 0.0002}
    scene = {**{key: BAG_SCENE[key] for key in ("provenance", "cloth")}, "cameras": {"cam0": camera}}
    (scratch_folder() / "tum.json").write_text(json.dumps(scene))
    return folder


@register_format("tum", mutations.mutate_text, READING)
def read_tum(data: bytes) -> None:
    """Read the three lists of a TUM folder."""
    folder = prepared_tum_folder()
    write_parts(folder, ("rgb.txt", "depth.txt", "groundtruth.txt"), data)
    invariants.check_recording(formats.read(folder, scene=scratch_folder() / "tum.json"))


@register_format("pcd", mutations.mutate_text, READING)
def read_pcd(data: bytes) -> None:
    """Read a folder of one cloud, its table of times, and the table of a gripper's poses."""
    folder, scene = scratch_folder() / "pcd", scratch_folder() / "pcd.json"
    folder.mkdir(exist_ok=True)
    source = {"times": "stamps.csv", "motion": {"left": {"file": "poses.csv", "closed": True}}}
    scene.write_text(json.dumps({**{key: BAG_SCENE[key] for key in ("provenance", "cloth")}, "source": source}))
    write_parts(folder, ("1.pcd", "stamps.csv", "poses.csv"), data)
    invariants.check_recording(formats.read(folder, scene=scene))


@register_format("bench", mutations.mutate_text, READING)
def read_bench(data: bytes) -> None:
    """Read a log of joints, the intrinsics and the pose of a camera, as ``torchcloth new`` does."""
    folder = scratch_folder() / "bench"
    folder.mkdir(exist_ok=True)
    write_parts(folder, ("joints.csv", "K.json", "T.txt"), data)
    limits = np.full(len(BENCH_JOINTS), 3.0)
    log = read_joint_log(folder / "joints.csv", JointNames(BENCH_JOINTS, limits < 0, -limits, limits, "arm"))
    require(log.q.shape == (len(log.ns), len(BENCH_JOINTS)), "every joint has a position at every time")
    require((np.diff(log.ns) > 0).all(), "times increase")
    require(log.closed is None or len(log.closed) == len(log.ns), "the gripper is open or closed at every time")
    invariants.check_finite([("joints", log.q)])
    camera = {"width": 640, "height": 480, **read_intrinsics(folder / "K.json")}
    invariants.check_camera(rec.Camera(T_world_camera=read_pose(folder / "T.txt"), **camera), "camera")


@register_format("tension", mutations.mutate_text, READING)
def read_tension(data: bytes) -> None:
    """Read the two files of a table of a tension machine."""
    folder = scratch_folder() / "tension"
    folder.mkdir(exist_ok=True)
    write_parts(folder, ("table.json", "table.csv"), data)
    table = rec.read_tension(folder)
    require(table.displacement.shape == table.force.shape == (len(table),), "columns are as long as each other")
    require(table.length > 0 and table.width > 0, "the strip has a size")
    numbers = table.length, table.width, table.angle, table.preload
    invariants.check_finite([("numbers", np.array(numbers)), ("strain", table.strain), ("force", table.force)])
    require(table.repeat is None or table.repeat.dtype.kind == "i", "repeats are whole")


@register_format("checkpoint", mutations.mutate_zip, "torchcloth.training.fit", "torch._weights_only_unpickler")
def read_checkpoint(data: bytes) -> None:
    """Read a checkpoint of ``training.fit``, and build the cloth with the learned values."""
    from ...fit.module import FitModule

    cloth = FitModule.load_from_checkpoint(write_input("last.ckpt", data)).cloth()
    invariants.check_mesh(cloth.mesh)
    values = ((name, parameter.detach()) for name, parameter in cloth.named_parameters())
    invariants.check_finite(values)
