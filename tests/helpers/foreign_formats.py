"""Tiny recordings in other formats, written by the libraries of those formats, with their true content."""

from __future__ import annotations

import io
import json
import struct
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path

import numpy as np
from PIL import Image

from helpers import lerobot_dataset as lerobot_truth

CAMERA_POSE = [[0.0, 1.0, 0.0, 0.5], [1.0, 0.0, 0.0, 0.1], [0.0, 0.0, -1.0, 1.5], [0.0, 0.0, 0.0, 1.0]]
CLOTH_DESCRIPTION = {"sheet": {"width": 0.3, "height": 0.2}, "areal_density": 0.15, "thickness": 5e-4}
SCENE_DESCRIPTION = {"cloth": CLOTH_DESCRIPTION, "provenance": "measured"}
IMAGE_WIDTH_PX, IMAGE_HEIGHT_PX, FRAME_COUNT = 16, 12, 3
FIRST_STAMP_NS = 1_700_000_000_123_456_789  # not a multiple of the resolution of float64 seconds


@dataclass
class ForeignRecording:
    """A recording on disk, the scene description that completes it, and the expected content."""

    path: Path
    scene: dict
    images: dict[str, list[np.ndarray]] = field(default_factory=dict)  # "camera/kind": pixels
    times: dict[str, list[float]] = field(default_factory=dict)  # likewise [s]
    arrays: dict[str, np.ndarray] = field(default_factory=dict)  # "name/key" of the motion; "points/xyz"
    options: dict = field(default_factory=dict)

    def write_scene(self) -> Path:
        path = self.path.parent / "scene.json"
        path.write_text(json.dumps(self.scene))
        return path


def draw_images(seed: int = 0) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return depth [mm, 1 to 2 m, some invalid] and colour images."""
    rng = np.random.default_rng(seed)
    depth = [rng.integers(1000, 2000, (IMAGE_HEIGHT_PX, IMAGE_WIDTH_PX)).astype(np.uint16) for _ in range(FRAME_COUNT)]
    depth[0][0, :3] = 0
    return depth, [
        rng.integers(0, 255, (IMAGE_HEIGHT_PX, IMAGE_WIDTH_PX, 3), dtype=np.uint8) for _ in range(FRAME_COUNT)
    ]


def encode_jpeg(pixels: np.ndarray) -> bytes:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "JPEG", quality=95)
    return file.getvalue()


def encode_png(pixels: np.ndarray) -> bytes:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "PNG")
    return file.getvalue()


def decode_image(data: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))


def write_redwood(folder: Path) -> ForeignRecording:
    """Write a Redwood folder by open3d.io."""
    import open3d as o3d

    root, (depth, color) = folder / "redwood", draw_images()
    for kind in ("depth", "color"):
        (root / kind).mkdir(parents=True)
    stamps = [33_369, 66_736, 100_103]
    for i, us in enumerate(stamps):
        name = f"{i + 1:07d}-{us:012d}.png"
        o3d.io.write_image(str(root / "depth" / name), o3d.geometry.Image(depth[i]))
        o3d.io.write_image(str(root / "color" / name), o3d.geometry.Image(color[i]))
    intrinsic = o3d.camera.PinholeCameraIntrinsic(IMAGE_WIDTH_PX, IMAGE_HEIGHT_PX, 14.0, 15.0, 7.5, 5.25)
    o3d.io.write_pinhole_camera_intrinsic(str(root / "camera_intrinsic.json"), intrinsic)
    one = o3d.camera.PinholeCameraParameters()
    one.intrinsic, one.extrinsic = intrinsic, np.linalg.inv(CAMERA_POSE)  # Open3D's extrinsic is world to camera
    trajectory = o3d.camera.PinholeCameraTrajectory()
    trajectory.parameters = [one] * FRAME_COUNT
    o3d.io.write_pinhole_camera_trajectory(str(root / "trajectory.log"), trajectory)
    times = [(us - stamps[0]) / 1e6 for us in stamps]
    images = {"cam0/depth": depth, "cam0/color": color}
    return ForeignRecording(root, dict(SCENE_DESCRIPTION), images, dict.fromkeys(images, times))


INTRINSICS_PX = [[14.0, 0.0, 7.5], [0.0, 15.0, 5.25], [0.0, 0.0, 1.0]]


def write_tum(folder: Path) -> ForeignRecording:
    """Write a TUM folder; colour comes 12 ms after depth, with one more image at the end."""
    root, (depth, color) = folder / "tum", draw_images(1)
    color.append(color[0][::-1].copy())
    names = {"depth": ("depth", depth, 0), "rgb": ("color", color, 12_000)}
    times = {}
    for name, (kind, images, late) in names.items():
        (root / name).mkdir(parents=True)
        lines = [f"# {name} images", "# file: 'x.bag'", "# timestamp filename"]
        for i, pixels in enumerate(images):
            stamp = f"1305031102.{175_304 + i * 33_333 + late}"
            (root / name / f"{stamp}.png").write_bytes(encode_png(pixels))
            lines.append(f"{stamp} {name}/{stamp}.png")
        (root / f"{name}.txt").write_text("\n".join(lines) + "\n")
        times[f"cam0/{kind}"] = [(i * 33_333 + late) / 1e6 for i in range(len(images))]
    # x axis along +y, y along +x, z down: half a turn about (1, 1, 0)
    pose = "0.5 0.1 1.5 0.70710678 0.70710678 0.0 0.0"
    lines = ["# ground truth trajectory", "# timestamp tx ty tz qx qy qz qw"]
    lines += [f"{1305031102.1758 + i / 100:.4f} {pose}" for i in range(10)]
    (root / "groundtruth.txt").write_text("\n".join(lines) + "\n")
    scene = {
        **SCENE_DESCRIPTION,
        "cameras": {"cam0": {"K": INTRINSICS_PX, "distortion": [0.26, -0.95, -0.005, 0.0026, 1.16]}},
    }
    return ForeignRecording(root, scene, {"cam0/depth": depth, "cam0/color": color}, times)


def write_ros2(folder: Path, storage: str = "mcap", *, checksums: bool = False) -> ForeignRecording:
    """Write a bag by rosbags' writer, in standard messages of ROS 2; ``checksums``: add those of MCAP."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    from torchcloth.recordings.formats import mcap_checksums

    store = get_typestore(Stores.ROS2_HUMBLE)
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    root, (depth, color) = folder / f"bag_{storage}", draw_images(2)
    rng, n = np.random.default_rng(3), 5
    stamps = [FIRST_STAMP_NS + i * 10_000_000 for i in range(n)]
    position, quat = rng.normal(0, 0.2, (n, 3)), rng.normal(size=(n, 4))
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    q, width, force = rng.normal(size=(n, 7)), np.linspace(0.04, 0.0, n), rng.normal(size=(n, 6))
    clouds = [rng.normal(0, 0.2, (k, 3)).astype(np.float32) for k in (7, 4)]
    std, sensor, geometry = "std_msgs/msg/", "sensor_msgs/msg/", "geometry_msgs/msg/"

    def make(kind: str, *values):
        return store.types[kind](*values)

    def header(ns: int, frame: str = "world"):
        return make(std + "Header", make("builtin_interfaces/msg/Time", *divmod(ns, 10**9)), frame)

    def image(ns: int, encoding: str, pixels: np.ndarray):
        step = pixels.strides[0]
        raw = np.ascontiguousarray(pixels).reshape(-1).view(np.uint8)
        return make(sensor + "Image", header(ns, "lens"), IMAGE_HEIGHT_PX, IMAGE_WIDTH_PX, encoding, 0, step, raw)

    def info(ns: int):
        K, D = np.array(INTRINSICS_PX).reshape(-1), np.array([0.26, -0.95, -0.005, 0.0026, 1.16])
        P = np.column_stack([INTRINSICS_PX, np.zeros(3)]).reshape(-1)
        region = make(sensor + "RegionOfInterest", 0, 0, 0, 0, False)
        head = header(ns, "lens")
        return make(
            sensor + "CameraInfo",
            head,
            IMAGE_HEIGHT_PX,
            IMAGE_WIDTH_PX,
            "plumb_bob",
            D,
            K,
            np.eye(3).reshape(-1),
            P,
            0,
            0,
            region,
        )

    def cloud(ns: int, xyz: np.ndarray):
        fields = [make(sensor + "PointField", name, 4 * i, 7, 1) for i, name in enumerate("xyz")]
        padded = np.concatenate([xyz, np.full((1, 3), np.nan, dtype=np.float32)])
        data = padded.reshape(-1).view(np.uint8)
        size = len(padded)
        return make(sensor + "PointCloud2", header(ns), 1, size, fields, False, 12, 12 * size, data, False)

    with Writer(root, version=9, storage_plugin=plugin) as bag:

        def put(topic: str, kind: str, messages: list) -> None:
            connection = bag.add_connection(topic, kind, typestore=store)
            for ns, message in messages:
                bag.write(connection, ns + 1_500_000, store.serialize_cdr(message, kind))  # logged 1.5 ms later

        put("/closed", std + "Bool", [(stamps[0], make(std + "Bool", True)), (stamps[3], make(std + "Bool", False))])
        poses, based, joints, wrenches, sensed = [], [], [], [], []
        for i, ns in enumerate(stamps):
            w, x, y, z = quat[i].tolist()
            orientation = make(geometry + "Quaternion", x, y, z, w)
            pose = make(geometry + "Pose", make(geometry + "Point", *position[i].tolist()), orientation)
            poses.append((ns, make(geometry + "PoseStamped", header(ns), pose)))
            based.append((ns, make(geometry + "PoseStamped", header(ns, "base"), pose)))
            names = [*(f"j{k}" for k in range(7)), "finger"]
            values, none = np.append(q[i], width[i]), np.zeros(0)
            order = np.roll(np.arange(8), i)  # drivers do not promise an order
            state = make(sensor + "JointState", header(ns), [names[k] for k in order], values[order], none, none)
            joints.append((ns, state))
            vectors = [make(geometry + "Vector3", *part.tolist()) for part in np.split(force[i], 2)]
            wrench = make(geometry + "Wrench", *vectors)
            wrenches.append((ns, make(geometry + "WrenchStamped", header(ns), wrench)))
            sensed.append((ns, make(geometry + "WrenchStamped", header(ns, "sensor"), wrench)))
        put("/left/pose", geometry + "PoseStamped", poses)
        put("/left/pose_in_base", geometry + "PoseStamped", based)
        put("/joint_states", sensor + "JointState", joints)
        put("/left/ft", geometry + "WrenchStamped", wrenches)
        put("/left/ft_sensor", geometry + "WrenchStamped", sensed)
        put("/cloth", sensor + "PointCloud2", [(stamps[i], cloud(stamps[i], c)) for i, c in enumerate(clouds)])
        put("/lens/info", sensor + "CameraInfo", [(stamps[0], info(stamps[0]))])
        put("/lens/depth", sensor + "Image", [(stamps[i], image(stamps[i], "16UC1", d)) for i, d in enumerate(depth)])
        metres = [(d / 1000).astype(np.float32) for d in depth]
        metres[0][0, :3] = 20.0, np.inf, np.nan  # a far wall, too far, no reading: none is in the episode's range
        put(
            "/lens/metres",
            sensor + "Image",
            [(ns, image(ns, "32FC1", d)) for ns, d in zip(stamps, metres, strict=False)],
        )
        swapped = [np.ascontiguousarray(c[..., ::-1]) for c in color]
        put(
            "/lens/color",
            sensor + "Image",
            [(ns, image(ns, "bgr8", c)) for ns, c in zip(stamps, swapped, strict=False)],
        )
        compressed = [encode_jpeg(c) for c in color]
        kind, files = sensor + "CompressedImage", [np.frombuffer(c, dtype=np.uint8) for c in compressed]
        put(
            "/lens/jpeg",
            kind,
            [(ns, make(kind, header(ns, "lens"), "jpeg", c)) for ns, c in zip(stamps, files, strict=False)],
        )
    if storage == "mcap" and checksums:
        mcap_checksums.write_checksums(root / f"{root.name}.mcap")
    joint_map = {"topic": "/joint_states", "names": [f"j{k}" for k in range(7)], "width": "finger"}
    left = {"pose": "/left/pose", "closed": "/closed", "wrench": "/left/ft", "wrench_frame": "world"}
    scene = {
        **SCENE_DESCRIPTION,
        "robots": {"arm": {"model": "rizon4", "T_world_base": np.eye(4).tolist()}},
        "cameras": {
            "cam0": {"T_world_camera": CAMERA_POSE},
            "cam1": {"T_world_camera": CAMERA_POSE, "K": INTRINSICS_PX},
        },
        "source": {
            "motion": {"left": left, "arm": {"joints": joint_map, "closed": True}},
            "points": {"topic": "/cloth"},
            "cameras": {
                "cam0": {"depth": "/lens/depth", "color": "/lens/color", "info": "/lens/info"},
                "cam1": {"depth": "/lens/metres", "color": "/lens/jpeg"},
            },
        },
    }
    depth_in_fifths = [5 * d for d in depth]  # in units of 0.2 mm
    depth_in_fifths[0][0, :3] = 0
    images = {
        "cam0/depth": depth,
        "cam0/color": color,
        "cam1/depth": depth_in_fifths,
        "cam1/color": [decode_image(c) for c in compressed],
    }
    arrays = {
        "left/position": position,
        "left/quat_wxyz": quat,
        "left/force": force[:, :3],
        "left/torque": force[:, 3:],
    }
    arrays |= {"left/closed": np.arange(n) < 3, "arm/q": q, "arm/width": width, "arm/closed": np.ones(n, bool)}
    arrays |= {"left/t": np.arange(n) / 100, "arm/t": np.arange(n) / 100, "points/t": np.arange(2) / 100}
    arrays |= {"points/xyz": np.concatenate(clouds).astype(float)}
    times = {key: [i / 100 for i in range(FRAME_COUNT)] for key in images}
    return ForeignRecording(root, scene, images, times, arrays)


def copy_lerobot(folder: Path) -> ForeignRecording:
    """Copy the data set that lerobot itself wrote; expect its second episode."""
    import shutil

    root = Path(shutil.copytree(lerobot_truth.LEROBOT_FOLDER / "dataset", folder / "lerobot"))
    names = lerobot_truth.STATE_NAMES
    source = {
        "motion": {"left": {"column": "observation.state", "joints": names[:7], "unit": "rad", "width": names[7]}},
        "cameras": {"cam0": {"color": lerobot_truth.CAMERA_KEY}},
    }
    scene = {
        **SCENE_DESCRIPTION,
        "source": source,
        "cameras": {"cam0": {"T_world_camera": CAMERA_POSE, "K": [[84.0, 0, 47.5], [0, 85.0, 31.5], [0, 0, 1]]}},
    }
    length = lerobot_truth.EPISODE_LENGTHS[1]
    states = np.array([lerobot_truth.make_state(1, i) for i in range(length)], dtype=np.float64)
    t = np.arange(length) / lerobot_truth.DATASET_RATE_HZ
    grey = [
        np.full(
            (lerobot_truth.VIDEO_HEIGHT_PX, lerobot_truth.VIDEO_WIDTH_PX, 3), lerobot_truth.grey_level(1, i), np.uint8
        )
        for i in range(length)
    ]
    arrays = {"left/q": states[:, :7], "left/width": states[:, 7], "left/t": t}
    return ForeignRecording(root, scene, {"cam0/color": grey}, {"cam0/color": t.tolist()}, arrays, {"episode": 1})


FACTORY_LENS_PARAMETERS = [
    0.50148,
    0.49705,
    0.49204,
    0.49193,
    4.7247,
    3.2092,
    0.1706,
    5.0559,
    4.7758,
    0.88649,
    0,
    0,
    1.24e-4,
    5.9e-6,
]
DEPTH_CAMERA_TILT_RAD = 0.1  # of depth from colour; close to the real 6 degrees


def make_calibration() -> dict:
    """Return a calibration as k4arecorder attaches it; the depth lens is that of a real device (k4a issue 1617)."""
    c, s = np.cos(DEPTH_CAMERA_TILT_RAD), np.sin(DEPTH_CAMERA_TILT_RAD)
    turn = [1.0, 0.0, 0.0, 0.0, c, -s, 0.0, s, c]

    def lens(place: str, values: list, size: tuple[int, int], turn: list, shift: list) -> dict:
        model = {"ModelParameterCount": 14, "ModelParameters": values}
        model["ModelType"] = "CALIBRATION_LensDistortionModelBrownConrady"
        rt = {"Rotation": turn, "Translation": shift}
        return {"Intrinsics": model, "Location": place, "Rt": rt, "SensorWidth": size[0], "SensorHeight": size[1]}

    unmoved = np.eye(3).reshape(-1).tolist()
    color = [0.5, 0.5, 0.48, 0.64, *FACTORY_LENS_PARAMETERS[4:]]
    lenses = [
        lens("CALIBRATION_CameraLocationD0", FACTORY_LENS_PARAMETERS, (1024, 1024), unmoved, [0.0, 0.0, 0.0]),
        lens("CALIBRATION_CameraLocationPV0", color, (4096, 3072), turn, [-0.032, -0.002, 0.004]),
    ]
    return {"CalibrationInformation": {"Cameras": lenses}}


def write_kinect(folder: Path, *, size: tuple[int, int] = (320, 288), frames: int = FRAME_COUNT) -> ForeignRecording:
    """Write a file by FFmpeg's Matroska writer, with tracks, tags and attachment as k4arecorder writes them.

    FFmpeg stores raw video without its fourcc; it is added afterwards, as k4arecorder has it.
    """
    import av

    folder.mkdir(parents=True, exist_ok=True)
    path, rng = folder / "take.mkv", np.random.default_rng(4)
    blocks = [rng.integers(500, 3000, (size[1] // 32, size[0] // 32)) for _ in range(frames)]
    depth = [np.kron(b, np.ones((32, 32))).astype(np.uint16) for b in blocks]
    colors = [np.full((720, 1280, 3), 40 + 30 * i, dtype=np.uint8) for i in range(frames)]
    files = [encode_jpeg(c) for c in colors]
    with av.open(str(path), "w", format="matroska", container_options={"allow_raw_vfw": "1"}) as container:
        container.metadata["K4A_DEVICE_SERIAL_NUMBER"] = "000123"
        color = container.add_mux_stream("mjpeg", rate=30, width=1280, height=720, pix_fmt="yuvj420p")
        color.metadata["title"] = "COLOR"
        raw = container.add_stream("rawvideo", rate=30)
        raw.width, raw.height, raw.pix_fmt = *size, "gray16be"
        raw.metadata["title"] = "DEPTH"
        imu = container.add_mux_stream("subrip", rate=1000)
        imu.metadata["title"] = "IMU"
        container.add_attachment(
            "calibration.json", "application/octet-stream", json.dumps(make_calibration()).encode()
        )
        for i in range(frames):
            for stream, data in ((color, files[i]), (imu, bytes(24))):
                packet = av.Packet(data)
                packet.pts = packet.dts = i
                packet.time_base = Fraction(1, 30)
                packet.stream, packet.is_keyframe = stream, True
                container.mux(packet)
            frame = av.VideoFrame.from_ndarray(depth[i], format="gray16le").reformat(format="gray16be")
            frame.pts = i
            container.mux(raw.encode(frame))
        container.mux(raw.encode())
    data = bytearray(path.read_bytes())
    at = data.index(struct.pack("<IiiHH", 40, size[0], -size[1], 1, 16))
    data[at : at + 20] = struct.pack("<IiiHH4s", 40, *size, 1, 16, b"b16g")
    path.write_bytes(data.replace(b"S_TEXT/UTF8", b"S_K4A/IMU\0\0"))
    times = [round(i / 30, 3) for i in range(frames)]
    images = {"depth/depth": depth, "color/color": [decode_image(f) for f in files]}
    scene = {**SCENE_DESCRIPTION, "cameras": {"depth": {"T_world_camera": CAMERA_POSE}}}
    return ForeignRecording(path, scene, images, dict.fromkeys(images, times))


CLOUD_STAMPS_S = ("1753623328.250000", "1753623328.310000", "1753623328.372500")


def draw_clouds(seed: int) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [rng.uniform(-0.2, 0.2, (k, 3)).astype(np.float32) for k in (6, 4, 5)]


def write_cloud(path: Path, cloud: np.ndarray, *, ascii_text: bool = False, compressed: bool = False) -> None:
    """Write a cloud by open3d.io, which adds a colour."""
    import open3d as o3d

    points = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(cloud.astype(float)))
    points.paint_uniform_color([0.2, 0.4, 0.6])
    assert o3d.io.write_point_cloud(str(path), points, write_ascii=ascii_text, compressed=compressed)


def write_poses(path: Path, stamps: list[str], position: np.ndarray, quat: np.ndarray) -> None:
    """Write poses as RGBench's tools do, with the angles of the joints before them."""
    heads = ["time", *(f"pos_{k}" for k in range(1, 7)), "pos_gripper", "pos_x", "pos_y", "pos_z"]
    lines = [",".join([*heads, "orn_w", "orn_x", "orn_y", "orn_z"])]
    for stamp, x, q in zip(stamps, position.tolist(), quat.tolist(), strict=True):
        lines.append(",".join([stamp, *["0.1"] * 6, "0.02", *map(repr, [*x, *q])]))
    path.write_text("\n".join(lines) + "\n")


def write_pcd(folder: Path) -> ForeignRecording:
    """Write a folder of clouds in all three encodings by open3d.io, with tables of stamps and of a gripper's poses."""
    root, clouds, rng = folder / "pcd", draw_clouds(5), np.random.default_rng(6)
    root.mkdir(parents=True)
    names = [f"cloud_{i}.pcd" for i in (2, 0, 1)]  # the table gives the order
    for i, (name, cloud) in enumerate(zip(names, clouds, strict=True)):
        write_cloud(root / name, cloud, ascii_text=i == 0, compressed=i == 2)
    clouds[0] = np.loadtxt((root / names[0]).read_text().split("DATA ascii\n")[1].splitlines(), usecols=(0, 1, 2))
    rows = [f"{stamp},{name}" for stamp, name in zip(CLOUD_STAMPS_S, names, strict=True)]
    (root / "stamps.csv").write_text("\n".join(["timestamp_sec,filename", *rows]) + "\n")
    position, quat = rng.uniform(-0.2, 0.2, (5, 3)), rng.normal(size=(5, 4))
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    write_poses(root / "hand.csv", [f"1753623328.{24 + 4 * k}" for k in range(5)], position, quat)
    arrays = {"left/t": np.arange(5) / 25, "left/position": position, "left/quat_wxyz": quat}
    arrays |= {"left/closed": np.ones(5, bool), "points/t": np.array([0.01, 0.07, 0.1325])}
    arrays["points/xyz"] = np.concatenate(clouds).astype(float)
    scene = {**SCENE_DESCRIPTION, "source": {"motion": {"left": {"file": "hand.csv", "closed": True}}}}
    return ForeignRecording(root, scene, arrays=arrays)


def write_rgbench(folder: Path) -> ForeignRecording:
    """Write a capture in the layout of RGBench, whose grippers hold points of the clouds."""
    root, clouds, rng = folder / "fling", draw_clouds(7), np.random.default_rng(8)
    for name in ("calibration", "joints", "segment_pcds"):
        (root / name).mkdir(parents=True)
    (root / "calibration" / "world_to_camera_transform.json").write_text(
        json.dumps(np.linalg.inv(CAMERA_POSE).tolist())
    )
    for stamp, cloud in zip(CLOUD_STAMPS_S, clouds, strict=True):
        write_cloud(root / "segment_pcds" / f"pointcloud_{stamp}_segmented.pcd", cloud)
    pose = np.linalg.inv(np.linalg.inv(CAMERA_POSE))
    points = np.concatenate(clouds) @ pose[:3, :3].T + pose[:3, 3]
    arrays = {"points/t": np.array([0.0, 0.06, 0.1225]) + 0.06125, "points/xyz": points}
    for arm, y, k in (("left", 0.25, 0), ("right", -0.25, 1)):
        position, quat = points[k] + rng.uniform(-0.01, 0.01, (8, 3)), rng.normal(size=(8, 4))
        quat /= np.linalg.norm(quat, axis=1, keepdims=True)
        local = position - [0.0, y, 0.0]
        stamps = [f"1753623328.{250 + 30 * i}" for i in range(8)]
        write_poses(root / "joints" / f"{arm}_arm_joint_states_and_end_pose.csv", stamps, local, quat)
        arrays |= {f"{arm}/t": np.arange(8) * 0.03, f"{arm}/position": np.add(local, [0.0, y, 0.0])}
        arrays |= {f"{arm}/quat_wxyz": quat, f"{arm}/closed": np.ones(8, bool)}
    return ForeignRecording(root, dict(SCENE_DESCRIPTION), arrays=arrays)


WRITERS = {
    "redwood": write_redwood,
    "tum": write_tum,
    "ros2": write_ros2,
    "lerobot": copy_lerobot,
    "kinect": write_kinect,
    "pcd": write_pcd,
    "rgbench": write_rgbench,
}
