"""Recorded motion to end-effector trajectories, and back."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
import torch
from torch import Tensor

from torchcloth.errors import RecordingError
from torchcloth.recordings import GripperMotion, JointMotion, Recording
from torchcloth.recordings.consistency import check_recording
from torchcloth.recordings.files import is_present
from torchcloth.types import Trajectory

from .arm import Arm, load

MAX_HOLDING_WIDTH_M = 0.02  # fingers that are opened less hold the cloth, if only the width was recorded


def replay(
    recording: Recording, dtype: torch.dtype = torch.float64, names: Collection[str] | None = None
) -> dict[str, Trajectory]:
    """Return the world poses of every gripper of an episode, by name.

    Joint trajectories go through the arm's own kinematics. If an episode has joints and poses, the joints are used:
    they were measured and can be optimised. Poses are used if no arm is named.

    Args:
        recording: an episode.
        dtype: of the poses.
        names: only these grippers, of those that were recorded; an idle arm may be of an unknown model.

    Raises:
        RecordingError: joints without an arm to replay them on, or no motion at all.
        InvalidInput: the arm's model or frame is unknown.
    """
    check_recording(recording)
    paths = {}
    for name, motion in recording.grippers.items():
        if names is not None and name not in names:
            continue
        pose = _poses(motion.position, motion.quat_wxyz)
        paths[name] = Trajectory(_tensor(motion.t), pose.to(dtype), torch.as_tensor(motion.closed, dtype=torch.bool))
    for name, joints in recording.joints.items():
        is_wanted = names is None or name in names
        if not is_wanted or (name in paths and name not in recording.robots):
            continue
        pose = arm_from_recording(recording, name)(_tensor(joints.q))
        paths[name] = Trajectory(_tensor(joints.t), pose.to(dtype), _closed(joints))
    if not recording.grippers and not recording.joints:
        raise RecordingError(f"{recording.path}: no motion", expected="grippers or joints in motion.npz")
    return paths


def unwrap_joints(arm: Arm, q: np.ndarray) -> np.ndarray:
    """Return recorded joints [K, J] without the jumps of continuous joints: encoders give +-pi for the same angle."""
    arm.validate_joints(_tensor(q))
    columns = zip(q.T, arm.joint_types, strict=True)
    return np.stack([np.unwrap(column) if kind == "continuous" else column for column, kind in columns], axis=-1)


def list_closing_grippers(recording: Recording) -> list[str]:
    """List the grippers that are closed at some time, also those of unknown arms."""
    of_joints = {name: bool(_closed(joints).any()) for name, joints in recording.joints.items()}
    is_closing = {**of_joints, **{name: bool(motion.closed.any()) for name, motion in recording.grippers.items()}}
    return [name for name, closes in is_closing.items() if closes]


def to_gripper_motion(path: Trajectory) -> GripperMotion:
    """Return a path [K] as a recording stores it; ``replay`` gives it back."""
    pose = path.pose.detach().double().cpu().numpy()
    quat = _quaternions(pose[:, :3, :3])
    return GripperMotion(path.t.detach().double().cpu().numpy(), pose[:, :3, 3], quat, path.closed.cpu().numpy())


def arm_from_recording(recording: Recording, name: str) -> Arm:
    """Load the arm that an episode's joints of this name belong to, at its place in the world.

    Raises:
        RecordingError: the episode names no robot of that name.
        InvalidInput: the arm's model or frame is unknown.
    """
    if name not in recording.robots:
        raise RecordingError(
            f"{recording.path}: joints of {name!r}",
            got="no robot of that name",
            expected=f"robots.{name} in episode.json",
            remedy="name the model and its base pose",
        )
    robot = recording.robots[name]
    return load(locate_model(recording, name), frame=robot.tool_frame or "flange", base=_tensor(robot.T_world_base))


def locate_model(recording: Recording, name: str) -> str:
    """Return what an arm of an episode is loaded by: the path of a URDF file in the episode, or the model's name."""
    model = recording.robots[name].model
    file = None if recording.path is None else recording.path / model
    return model if file is None or not is_present(file) or not file.is_file() else str(file.resolve())


def _tensor(array: np.ndarray) -> Tensor:
    return torch.as_tensor(np.asarray(array, dtype=np.float64))


def _closed(joints: JointMotion) -> Tensor:
    if joints.closed is not None:
        return torch.as_tensor(joints.closed, dtype=torch.bool)
    if joints.width is not None:
        return torch.as_tensor(joints.width < MAX_HOLDING_WIDTH_M)
    return torch.ones(len(joints.t), dtype=torch.bool)


def _poses(position: np.ndarray, quat_wxyz: np.ndarray) -> Tensor:
    """[K, 4, 4] from positions [K, 3] m and unit quaternions [K, 4]."""
    from scipy.spatial.transform import Rotation

    pose = torch.eye(4, dtype=torch.float64).repeat(len(position), 1, 1)
    pose[:, :3, :3] = _tensor(Rotation.from_quat(np.roll(quat_wxyz, -1, axis=-1)).as_matrix())
    pose[:, :3, 3] = _tensor(position)
    return pose


def _quaternions(rotation: np.ndarray) -> np.ndarray:
    """[K, 4] wxyz of rotations [K, 3, 3], without jumps of sign."""
    from scipy.spatial.transform import Rotation

    q = np.roll(Rotation.from_matrix(rotation).as_quat(), 1, axis=-1)
    flips = np.cumprod(np.where((q[1:] * q[:-1]).sum(-1) < 0, -1.0, 1.0))
    return q * np.concatenate([[1.0], flips])[:, None] * np.sign(q[0, np.abs(q[0]).argmax()])
