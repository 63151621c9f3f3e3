"""Makes the seeds of fuzzing in tests/validation/fuzz/seeds: small sound files of every format.

    PYTHONPATH=tests python -m helpers.fuzz_seeds

Other files in these folders were found by fuzzing; they stay.
"""

from __future__ import annotations

import io
import sqlite3
import tempfile
from contextlib import closing
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch

from torchcloth import meshes
from torchcloth import recordings as rec
from torchcloth.meshes import obj
from torchcloth.recordings.files import save_npz

SEEDS_FOLDER = Path(__file__).parents[1] / "validation" / "fuzz" / "seeds"
FIRST_STAMP_NS = 1_700_000_000_000_000_000
KNOT_TIMES_S = np.array([0.0, 0.1, 0.25, 0.3])

ARM = """<robot name="arm"><link name="base"><visual><origin xyz="0 0 0.1" rpy="0 0 0"/><geometry><cylinder radius="0.1"
 length="0.2"/></geometry></visual></link>
<link name="upper"><inertial><origin xyz="0 0 0"/><mass value="1"/>
<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>
<collision><geometry><box size="0.1 0.2 0.3"/></geometry></collision></link>
<link name="slide"><collision><geometry><sphere radius="0.1"/></geometry></collision></link><link name="tool"/>
<joint name="turn" type="revolute"><origin xyz="0 0 0.3" rpy="0.1 0 -0.2"/><parent link="base"/><child link="upper"/>
<axis xyz="0 0 1"/><limit lower="-1.5" upper="1.5" velocity="2" effort="5"/>
<safety_controller soft_lower_limit="-1.4" soft_upper_limit="1.4" k_position="10" k_velocity="3"/></joint>
<joint name="push" type="prismatic"><parent link="upper"/><child link="slide"/><axis xyz="1 1 0"/>
<limit lower="0" upper="0.4" velocity="0.2" effort="5"/></joint>
<joint name="weld" type="fixed"><origin xyz="0.1 0 0" rpy="0 1.57 0"/><parent link="slide"/><child link="tool"/></joint>
</robot>
"""
SEWN_OBJ = """# two triangles of two panels
v 0 0 0
v 0.1 0 0
v 0.1 0.1 0
v 0 0.1 0
vt 0 0
vt 0.1 0
vt 0.1 0.1
vt 1 1
vt 1.1 1.1
vt 1 1.1
f 1/1 2/2 3/3
f 1/4 3/5 4/6
"""
POLYGON_OBJ = """o sheet
v 0 0 0
v 0.1 0 0
v 0.1 0.1 0.02 # a corner
v 0 0.1 0
vn 0 0 1
f -4//1 -3//1 -2//1 -1//1
"""
QUAD_PLY = """ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
property float s
property float t
element face 1
property list uchar int vertex_indices
end_header
0 0 0 0 0
0.1 0 0 0.1 0
0.1 0.1 0 0.1 0.1
0 0.1 0 0 0.1
4 0 1 2 3
"""
WEDGE_PLY = """ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
element face 2
property list uchar int vertex_indices
property list uchar float texcoord
end_header
0 0 0
0.1 0 0
0.1 0.1 0
0 0.1 0
3 0 1 2 6 0 0 0.1 0 0.1 0.1
3 0 2 3 6 0 0 0.1 0.1 0 0.1
"""

TUM_LISTS = """# colour
1305031102.175 rgb/1.png
1305031102.208 rgb/2.png

====
# depth
1305031102.170 depth/1.png
1305031102.203 depth/2.png

====
# timestamp tx ty tz qx qy qz qw
1305031102.17 0.5 0.1 1.5 0.6 0.8 0.0 0.0
1305031102.27 0.5 0.1 1.5 0.6 0.8 0.0 0.0
"""
PCD_HEADER = """# .PCD v0.7 - Point Cloud Data file format
VERSION 0.7
FIELDS x y z rgb
SIZE 4 4 4 4
TYPE F F F U
COUNT 1 1 1 1
WIDTH 2
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS 2
DATA """
PCD_POINTS = np.array([(0.1, 0.0, 0.5, 7), (0.1, 0.2, 0.5, 7)], "<f4,<f4,<f4,<u4")
CLOUD_TABLES = """
====
header.stamp.secs,header.stamp.nsecs,filename
1305031102,170000000,1.pcd
====
time,pos_1,pos_x,pos_y,pos_z,orn_w,orn_x,orn_y,orn_z
1305031102.17,0.1,0.5,0.1,0.4,0.6,0.8,0.0,0.0
1305031102.18,0.1,0.5,0.1,0.41,0.6,0.8,0.0,0.0
1305031102.19,0.1,0.5,0.1,0.42,0.6,0.8,0.0,0.0
"""
TENSION_TABLE = """{"format": "torchcloth-tension", "version": 1, "length": 0.097, "width": 0.027, "angle": 0.785,
 "preload": 0.15, "provenance": "measured", "licence": "CC0", "clamp": "rubber"}
====
repeat,displacement,force,lateral_strain
0,0.0,0.15,
0,0.00005,0.24,-0.0002
1,0.00010,0.31,-0.0003
"""


def write_seeds(folder: Path) -> None:
    """Write the seeds of every format into folders of this folder."""
    sheet = meshes.rectangle(0.3, 0.2, resolution=(3, 3))
    files = {
        "obj/sheet": obj.dump(sheet.vertices, sheet.faces, sheet.pattern).encode(),
        "obj/sewn": SEWN_OBJ.encode(),
        "obj/polygon": POLYGON_OBJ.encode(),
        "ply/quad": QUAD_PLY.encode(),
        "ply/wedge": WEDGE_PLY.encode(),
        "ply/binary": make_binary_ply(),
        "urdf/arm": ARM.encode(),
        "tum/lists": TUM_LISTS.encode(),
        **{f"pcd/{name}": cloud + CLOUD_TABLES.encode() for name, cloud in make_clouds().items()},
        "tension/table": TENSION_TABLE.encode(),
        "episode/all_keys": make_episode_json(),
        "tcm/model": make_model(),
        "checkpoint/scalars": make_checkpoint(),
        **{f"npz/{name}": make_npz(arrays) for name, arrays in make_arrays().items()},
        "mcap/bag": make_bag("mcap"),
        "mcap/checksums": make_bag("mcap", checksums=True),
        "mcap/of_our_own_writer": make_own_mcap(),
        "sqlite/bag": make_bag("sqlite3"),
        "rosbag1/bag": make_bag("ros1"),
    }
    for name, content in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)


def make_binary_ply() -> bytes:
    head = b"ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
    head += b"property float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
    corners = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]], dtype="<f4").tobytes()
    return head + corners + b"\x03" + np.array([0, 1, 2], dtype="<i4").tobytes()


def make_npz(arrays: dict[str, np.ndarray]) -> bytes:
    file = io.BytesIO()
    save_npz(file, arrays)
    return file.getvalue()


def make_arrays() -> dict[str, dict[str, np.ndarray]]:
    t, closed = KNOT_TIMES_S, np.array([True, True, False, False])
    rng = np.random.default_rng(0)
    xyz = rng.normal(0, 0.2, (7, 3))
    gripper = {"t": t, "position": rng.normal(0, 0.2, (4, 3)), "quat_wxyz": np.tile([1.0, 0, 0, 0], (4, 1))}
    arm = {"t": t, "q": rng.normal(size=(4, 2)), "width": np.array([0.05, 0.03, 0.01, 0.0]), "closed": closed}
    gripper |= {"closed": closed, "force": rng.normal(size=(4, 3)), "torque": rng.normal(size=(4, 3))}
    markers = rng.normal(0, 0.1, (4, 2, 3))
    markers[1, 0] = np.nan
    return {
        "motion": {f"{name}/{k}": v for name, group in (("left", gripper), ("arm", arm)) for k, v in group.items()},
        "points": {"t": t[:3], "xyz": xyz.astype(np.float32), "counts": np.array([3, 1, 3])},
        "compact_points": {
            "t": t[:3],
            "xyz": (xyz * 1e3).astype(np.int16),
            "scale": np.array(1e-3),
            "counts": np.array([3, 1, 3]),
        },
        "markers": {"t": t, "xyz": markers, "uv": np.array([[0.0, 0.0], [0.3, 0.2]])},
        "truth": {"t": t, "vertices": rng.normal(0, 0.2, (4, 4, 3)), "faces": np.array([[0, 1, 2], [0, 2, 3]])},
    }


def make_episode_json() -> bytes:
    from torchcloth.training.validation.fuzz.targets import prepared_episode

    return (prepared_episode() / "episode.json").read_bytes()


def make_model() -> bytes:
    from torchcloth.diagnosis import build_base_model, list_hypotheses, save_model

    from . import sheet_episodes

    recording = sheet_episodes.make_episode(resolution=(3, 3))
    base = build_base_model(recording)
    by_name = {h.name: h for h in list_hypotheses(base, [recording])}
    model = base.with_hypothesis(by_name["air.drag_n"], 1.5)
    size = len(model.parameters) + 1
    with tempfile.TemporaryDirectory() as folder:
        path = save_model(Path(folder) / "model.tcm", model, recording, torch.eye(size, dtype=torch.float64))
        return path.read_bytes()


def make_checkpoint() -> bytes:
    from torchcloth.training.fit import config
    from torchcloth.training.fit.cloth_description import describe_cloth
    from torchcloth.training.fit.module import FitModule

    from . import sheet_episodes

    recording = sheet_episodes.make_episode(resolution=(3, 3))
    settings = config.Config(
        out="out",
        data=config.Data(train="episode"),
        learn=config.Learn(parameters=["youngs_modulus"], fields=["areal_density"]),
        loss={"points": 1e-3},
    )
    plain, description = asdict(settings), describe_cloth(recording)
    module = FitModule(plain, description, "problem")
    content = {
        "pytorch-lightning_version": "2.4.0",
        "state_dict": module.state_dict(),
        "hyper_parameters": {"config": plain, "description": description, "problem": "problem"},
        "history": {0: {"train/loss": 0.5, "youngs_modulus": 1.0}},
        "epoch": 0,
        "global_step": 1,
    }
    file = io.BytesIO()
    torch.save(content, file)
    return file.getvalue()


def make_bag(storage: str, *, checksums: bool = False) -> bytes:
    """Make a bag with every kind of message that is read; ``storage`` is mcap, sqlite3 or ros1."""
    from rosbags.rosbag1 import Writer as Ros1Writer
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    from torchcloth.recordings.formats import mcap_checksums

    is_ros1 = storage == "ros1"
    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / ("bag.bag" if is_ros1 else "bag")
        plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
        with Ros1Writer(path) if is_ros1 else Writer(path, version=9, storage_plugin=plugin) as bag:  # type: ignore[attr-defined]
            for topic, kind, messages in make_messages(store, is_ros1):
                connection = bag.add_connection(topic, kind, typestore=store)
                serialise = store.serialize_ros1 if is_ros1 else store.serialize_cdr
                for ns, message in messages:
                    bag.write(connection, ns + 1_500_000, serialise(message, kind))
        file = path if path.is_file() else next(p for p in path.iterdir() if p.suffix in (".mcap", ".db3"))
        if storage == "sqlite3":
            with closing(sqlite3.connect(file)) as database:  # small pages make a small file
                database.execute("pragma page_size=512")
                database.execute("vacuum")
        if checksums:
            mcap_checksums.write_checksums(file)
        return file.read_bytes()


def make_clouds() -> dict[str, bytes]:
    """Make a cloud in each encoding; LZF has the first point as literals, and the second one refers to it."""
    first, second = (PCD_POINTS[k : k + 1].tobytes() for k in (0, 1))
    fields = b"".join(PCD_POINTS[name].tobytes() for name in PCD_POINTS.dtype.names)
    x, rest = fields[:4], fields[8:]
    packed = bytes([3]) + x + bytes([2 << 5, 3]) + bytes([len(rest) - 1]) + rest
    sizes = np.array([len(packed), len(fields)], "<u4").tobytes()
    text = "0.1 0 0.5 7\n0.1 0.2 0.5 7"
    bodies = {"ascii": text.encode(), "binary": first + second, "binary_compressed": sizes + packed}
    return {name: f"{PCD_HEADER}{name}\n".encode() + body for name, body in bodies.items()}


def make_own_mcap() -> bytes:
    """Make a file that carries its scene and small files beside standard messages."""
    from torchcloth.recordings import formats
    from torchcloth.training.validation.fuzz.targets import prepared_episode

    with tempfile.TemporaryDirectory() as folder:
        return formats.write_mcap(rec.read(prepared_episode(), with_truth=True), Path(folder) / "own.mcap").read_bytes()


def make_messages(store, is_ros1: bool):
    """Topics, types and stamped messages of a bag."""
    std, sensor, geometry = "std_msgs/msg/", "sensor_msgs/msg/", "geometry_msgs/msg/"
    stamps = [FIRST_STAMP_NS + 10_000_000 * i for i in range(3)]
    none = np.zeros(0)

    def make(kind: str, *values):
        return store.types[kind](*values)

    def header(ns: int, frame: str = "world"):
        stamp = make("builtin_interfaces/msg/Time", *divmod(ns, 10**9))
        return make(std + "Header", *([0] if is_ros1 else []), stamp, frame)

    def vector(*values: float):
        return make(geometry + "Vector3", *values)

    def pose(i: int, ns: int):
        at = make(geometry + "Point", 0.1 * i, 0.0, 0.5)
        return make(
            geometry + "PoseStamped",
            header(ns),
            make(geometry + "Pose", at, make(geometry + "Quaternion", 0.0, 0.0, 0.6, 0.8)),
        )

    def wrench(ns: int):
        return make(geometry + "WrenchStamped", header(ns), make(geometry + "Wrench", vector(1, 2, 3), vector(0, 0, 1)))

    def joints(i: int, ns: int):
        values = np.array([0.1 * i, 0.2, 0.03])
        return make(sensor + "JointState", header(ns), ["j1", "j2", "finger"], values, none, none)

    def cloud(ns: int):
        xyz = np.array([[0.1, 0, 0], [0, 0.1, 0.5]], dtype=np.float32)
        fields = [make(sensor + "PointField", name, 4 * k, 7, 1) for k, name in enumerate("xyz")]
        return make(
            sensor + "PointCloud2", header(ns), 1, 2, fields, False, 12, 24, xyz.reshape(-1).view(np.uint8), True
        )

    def depth(ns: int):
        pixels = np.arange(600, 612, dtype=np.uint16).reshape(3, 4)
        return make(sensor + "Image", header(ns, "lens"), 3, 4, "16UC1", 0, 8, pixels.reshape(-1).view(np.uint8))

    def info(ns: int):
        K = np.array([[5.0, 0, 2], [0, 5, 1.5], [0, 0, 1]])
        region = make(sensor + "RegionOfInterest", 0, 0, 0, 0, False)
        P = np.column_stack([K, np.zeros(3)]).reshape(-1)
        head, R = header(ns, "lens"), np.eye(3).reshape(-1)
        return make(
            sensor + "CameraInfo",
            head,
            3,
            4,
            "plumb_bob",
            np.zeros(5),
            K.reshape(-1),
            R,
            P,
            0,
            0,
            region,
        )

    flags = [(stamps[0], make(std + "Bool", True)), (stamps[2], make(std + "Bool", False))]
    yield "/closed", std + "Bool", flags
    yield "/pose", geometry + "PoseStamped", [(ns, pose(i, ns)) for i, ns in enumerate(stamps)]
    yield "/wrench", geometry + "WrenchStamped", [(ns, wrench(ns)) for ns in stamps]
    yield "/joints", sensor + "JointState", [(ns, joints(i, ns)) for i, ns in enumerate(stamps)]
    yield "/cloud", sensor + "PointCloud2", [(ns, cloud(ns)) for ns in stamps[:2]]
    yield "/depth", sensor + "Image", [(ns, depth(ns)) for ns in stamps[:2]]
    yield "/info", sensor + "CameraInfo", [(stamps[0], info(stamps[0]))]


if __name__ == "__main__":
    torch.set_default_dtype(torch.float64)
    write_seeds(SEEDS_FOLDER)
