"""The files of a bench, and what stands in them: arms with their joints, a camera with its depth images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from ..errors import InvalidInput
from ..observe import decode_depth
from ..recordings import Camera, ImageStream
from ..recordings.formats.calibration_files import read_intrinsics, read_pose
from ..recordings.formats.depth_folder import DepthFolder, read_depth_folder
from ..recordings.formats.imported import MILLIMETRE_DEPTH_SCALE_M, check_depth_scale, image_size
from ..recordings.formats.joint_log import AngleUnit, JointLog, JointNames, read_joint_log
from ..recordings.formats.tables import TimeUnit
from ..robots import Arm, load  # pyright: ignore[reportMissingImports] - mapped from robots/ at installation

ALONE_NAME = "gripper"


@dataclass(frozen=True, kw_only=True)
class ArmFiles:
    """Files of one arm, and the place of the sheet that its gripper holds.

    Attributes:
        urdf: path of its URDF, or the name of a shipped arm.
        tool: link that holds the cloth.
        joints: CSV file of the joint angles.
        grip: (u, v) m, pattern coordinates of the place.
        is_bar: whether a bar holds the whole edge through that place.
        base: text file with the pose of the URDF's root link in the world; None: the world is the root link.
        name: of the gripper; None: "gripper", with a number if there are several.
    """

    urdf: str | Path
    tool: str
    joints: str | Path
    grip: tuple[float, float]
    is_bar: bool = False
    base: str | Path | None = None
    name: str | None = None


@dataclass(frozen=True, kw_only=True)
class CameraFiles:
    """Files of a depth camera that stands still.

    Attributes:
        depth: folder of 16-bit PNG files.
        intrinsics: JSON file of the camera matrix.
        pose: text file of the camera's pose in the world; None: found from the arm in view.
        times: table with a time of each image; None: found beside them, or in their names.
        fps: images per second, if nothing gives their times.
        depth_scale: m per unit of the images; None: as the intrinsics say, or millimetres.
        span: (first, last) s after the first image that are used; None: all.
    """

    depth: str | Path
    intrinsics: str | Path
    pose: str | Path | None = None
    times: str | Path | None = None
    fps: float | None = None
    depth_scale: float | None = None
    span: tuple[float, float] | None = None


class BenchArm(NamedTuple):
    """An arm and its joints, as read.

    Attributes:
        arm: its kinematics, at its place in the world.
        log: of its joints.
        files: where it is from.
    """

    arm: Arm
    log: JointLog
    files: ArmFiles


class BenchCamera(NamedTuple):
    """A depth camera and its images, as read.

    Attributes:
        camera: with the depth images; times are 0 at the first one.
        ns: [N] ns, times as recorded.
    """

    camera: Camera
    ns: np.ndarray


def read_arms(
    files: Sequence[ArmFiles], angle_unit: AngleUnit | None, time_unit: TimeUnit | None
) -> tuple[dict[str, BenchArm], list[str]]:
    """Read the arms by name of their grippers, and notes on what was guessed."""
    if not files:
        raise InvalidInput("arms", got="none", expected="one arm or more")
    numbered = [ALONE_NAME] if len(files) == 1 else [f"{ALONE_NAME}{k}" for k in range(1, len(files) + 1)]
    names = [file.name or name for file, name in zip(files, numbered, strict=True)]
    if len(set(names)) < len(names):
        raise InvalidInput("names of the grippers", got=", ".join(names), expected="one name for each")
    unplaced = [file for file in files if file.base is None]
    is_one_robot = len({str(file.urdf) for file in files}) == 1 and len({file.tool for file in files}) == len(files)
    if unplaced and len(files) > 1 and not is_one_robot:
        got = f"{len(unplaced)} of {len(files)} arms without it"
        raise InvalidInput("base", got=got, expected="the pose of each arm in the world", remedy="give --base for each")
    arms: dict[str, BenchArm] = {}
    notes = []
    for name, file in zip(names, files, strict=True):
        base = None if file.base is None else torch.as_tensor(read_pose(Path(file.base)))
        arm = load(file.urdf, frame=file.tool, base=base)
        log = read_joint_log(Path(file.joints), _joint_names(arm, name), angle_unit=angle_unit, time_unit=time_unit)
        arms[name] = BenchArm(arm, log, file)
        notes += [note for note in log.notes if note not in notes]
        if log.closed is None:
            notes.append(f"{name}: closed all the time, as {Path(file.joints).name} has no column 'closed'")
    if unplaced:
        notes.append("world: the root link of the URDF, with z up (else give --base)")
    return arms, notes


def depth_stream(camera: Camera) -> ImageStream:
    """Return the depth images of a camera, which every camera of a bench has."""
    assert camera.depth is not None
    return camera.depth


def load_depth(camera: Camera, image: int) -> np.ndarray:
    """Decode a depth image [H, W] m."""
    assert camera.depth_scale is not None
    return decode_depth(depth_stream(camera).load(image), camera.depth_scale)


def _joint_names(arm: Arm, name: str) -> JointNames:
    """The arm's joints with limits that can be believed: equal ones and those in degrees count as none."""
    lower, upper = arm.limits.lower.numpy().copy(), arm.limits.upper.numpy().copy()
    is_prismatic = np.array([kind == "prismatic" for kind in arm.joint_types])
    is_strange = (lower == upper) | (~is_prismatic & (np.maximum(np.abs(lower), np.abs(upper)) > 4 * np.pi))
    lower[is_strange], upper[is_strange] = -np.inf, np.inf
    return JointNames(tuple(arm.joint_names), is_prismatic, lower, upper, name)


def read_camera(files: CameraFiles, time_unit: TimeUnit | None) -> tuple[BenchCamera, list[str]]:
    """Read a camera and list its images, and notes on what was guessed."""
    calibration = read_intrinsics(Path(files.intrinsics))
    times = None if files.times is None else Path(files.times)
    images = read_depth_folder(Path(files.depth), times=times, fps=files.fps, time_unit=time_unit)
    images, notes = _select_span(images, files.span), list(images.notes)
    size = image_size(images.paths[0])
    stated = calibration.get("width", size[0]), calibration.get("height", size[1])
    if stated != size:
        got = f"images of {size[0]} x {size[1]} px"
        raise InvalidInput(f"{files.depth}", got=got, expected=f"{stated[0]} x {stated[1]}, as {files.intrinsics} says")
    scale = files.depth_scale or calibration.get("depth_scale")
    if scale is None:
        notes.append("depth: in millimetres (else give --depth-scale)")
    t = (images.ns - images.ns[0]) / 1e9
    stream = ImageStream("depth", np.arange(len(t)), t, images.paths, size)
    scale = scale or MILLIMETRE_DEPTH_SCALE_M
    check_depth_scale(stream, scale, images.paths[0], is_assumed=False)
    camera = Camera(
        width=size[0],
        height=size[1],
        K=calibration["K"],
        T_world_camera=np.eye(4) if files.pose is None else read_pose(Path(files.pose)),
        distortion=calibration.get("distortion", np.zeros(0)),
        depth_scale=scale,
        depth=stream,
    )
    return BenchCamera(camera, images.ns), notes


def _select_span(images: DepthFolder, span: tuple[float, float] | None) -> DepthFolder:
    if span is None:
        return images
    seconds = (images.ns - images.ns[0]) / 1e9
    chosen = np.flatnonzero((seconds >= span[0]) & (seconds <= span[1]))
    if len(chosen) < 2:
        got = f"{len(chosen)} images from {span[0]:g} to {span[1]:g} s"
        raise InvalidInput("span", got=got, expected=f"a part of 0 to {seconds[-1]:.4g} s")
    return images._replace(paths=tuple(images.paths[k] for k in chosen), ns=images.ns[chosen])
