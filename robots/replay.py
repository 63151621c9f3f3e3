"""Recorded motion to end-effector trajectories, and back."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
import torch
from torch import Tensor

from torchcloth.errors import RecordingError
from torchcloth.recordings import GripperMotion, JointMotion, Recording
from torchcloth.recordings.consistency import check_recording
from torchcloth.types import Trajectory

from .arm import Arm, load

HOLDING_WIDTH = 0.02  # m, fingers opened less than this hold the cloth, when only the width was recorded


def replay(
    recording: Recording, dtype: torch.dtype = torch.float64, names: Collection[str] | None = None
) -> dict[str, Trajectory]:
    """The world poses of every gripper of an episode, by name.

    Joint trajectories go through the arm's own kinematics; where an episode has joints and poses, the joints win:
    they are what was measured, and what can be optimised, unless no arm is named.

    Args:
        recording: an episode.
        dtype: of the poses.
        names: only these, of those that there are: an arm that stands by may be one that nobody knows.

    Raises:
        RecordingError: joints without an arm to replay them on, or no motion at all.
        InvalidInput: the arm's model or frame is unknown.
    """
    check_recording(recording)
    out = {}
    wanted = lambda name: names is None or name in names  # noqa: E731
    for name, motion in recording.grippers.items():
        if not wanted(name):
            continue
        pose = _poses(motion.position, motion.quat_wxyz)
        out[name] = Trajectory(_tensor(motion.t), pose.to(dtype), torch.as_tensor(motion.closed, dtype=torch.bool))
    for name, joints in recording.joints.items():
        if not wanted(name) or (name in out and name not in recording.robots):
            continue
        pose = arm_of(recording, name)(_tensor(joints.q))
        out[name] = Trajectory(_tensor(joints.t), pose.to(dtype), _closed(joints))
    if not recording.grippers and not recording.joints:
        raise RecordingError(f"{recording.path}: no motion", expected="grippers or joints in motion.npz")
    return out


def unwound(arm: Arm, q: np.ndarray) -> np.ndarray:
    """Recorded joints [K, J] without the jumps of those that turn without end: encoders say +-pi for the same angle."""
    arm.checked(_tensor(q))
    columns = zip(q.T, arm.joint_types, strict=True)
    return np.stack([np.unwrap(own) if kind == "continuous" else own for own, kind in columns], axis=-1)


def closing(recording: Recording) -> list[str]:
    """The grippers that are closed at some time, also of arms that nobody knows."""
    of_joints = {name: bool(_closed(joints).any()) for name, joints in recording.joints.items()}
    own = {**of_joints, **{name: bool(motion.closed.any()) for name, motion in recording.grippers.items()}}
    return [name for name, closes in own.items() if closes]


def gripper_motion(path: Trajectory) -> GripperMotion:
    """A path [K] as a recording stores it; `replay` gives it back."""
    pose = path.pose.detach().double().cpu().numpy()
    quat = _quaternions(pose[:, :3, :3])
    return GripperMotion(path.t.detach().double().cpu().numpy(), pose[:, :3, 3], quat, path.closed.cpu().numpy())


def arm_of(recording: Recording, name: str) -> Arm:
    """The arm that an episode's joints of this name belong to, where it stands.

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
    return load(model_of(recording, name), frame=robot.tool_frame or "flange", base=_tensor(robot.T_world_base))


def model_of(recording: Recording, name: str) -> str:
    """What an arm of an episode is loaded by: the path of a URDF file beside it, or what the episode says."""
    model = recording.robots[name].model
    beside = None if recording.path is None else recording.path / model
    return model if beside is None or not beside.is_file() else str(beside.resolve())


def _tensor(array: np.ndarray) -> Tensor:
    return torch.as_tensor(np.asarray(array, dtype=np.float64))


def _closed(joints: JointMotion) -> Tensor:
    if joints.closed is not None:
        return torch.as_tensor(joints.closed, dtype=torch.bool)
    if joints.width is not None:
        return torch.as_tensor(joints.width < HOLDING_WIDTH)
    return torch.ones(len(joints.t), dtype=torch.bool)


def _poses(position: np.ndarray, quat_wxyz: np.ndarray) -> Tensor:
    """[K, 4, 4] from positions [K, 3] m and unit quaternions [K, 4]."""
    w, x, y, z = _tensor(quat_wxyz).unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    pose = torch.eye(4, dtype=torch.float64).repeat(len(position), 1, 1)
    pose[:, :3, :3] = torch.stack([torch.stack(row, -1) for row in rows], -2)
    pose[:, :3, 3] = _tensor(position)
    return pose


def _quaternions(rotation: np.ndarray) -> np.ndarray:
    """[K, 4] wxyz, without jumps of sign, of rotations [K, 3, 3]: eigenvectors of a symmetric matrix (Bar-Itzhack)."""
    k = np.zeros((len(rotation), 4, 4))
    k[:, 0, 0] = np.trace(rotation, axis1=1, axis2=2)
    skew = rotation - rotation.transpose(0, 2, 1)
    k[:, 0, 1:] = k[:, 1:, 0] = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], -1)
    k[:, 1:, 1:] = rotation + rotation.transpose(0, 2, 1) - k[:, 0, 0, None, None] * np.eye(3)
    q = np.linalg.eigh(k)[1][..., -1]
    flips = np.cumprod(np.where((q[1:] * q[:-1]).sum(-1) < 0, -1.0, 1.0))
    return q * np.concatenate([[1.0], flips])[:, None] * np.sign(q[0, np.abs(q[0]).argmax()])
