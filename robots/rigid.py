"""Formulas of rigid motions that several modules of this package share."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchcloth.errors import InvalidInput


def origin_matrix(xyz: Sequence[float], rpy: Sequence[float]) -> Tensor:
    """Return the ``[4, 4]`` float64 matrix of a URDF origin.

    Roll, pitch and yaw are about fixed axes: R = Rz Ry Rx.
    """
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(angle), math.sin(angle)) for angle in rpy)
    x, y, z = xyz
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr, x],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr, y],
        [-sp, cp * sr, cp * cr, z],
        [0.0, 0.0, 0.0, 1.0],
    ]
    return torch.tensor(rows, dtype=torch.float64)


def joint_modes(origin: Tensor, axis: Tensor, prismatic: Tensor) -> Tensor:
    """Return ``[J, 4, 4, 4]`` modes of the joints: the pose of joint j is modes[j] applied to (1, cos q, sin q, q).

    This is exact for every joint type. A revolute joint follows Rodrigues: R = a a' + cos q (I - a a') + sin q [a]x. A
    prismatic joint translates by q a.
    """
    x, y, z = axis.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
    along = axis[:, :, None] * axis[:, None, :]
    eye = torch.eye(3, dtype=axis.dtype).expand_as(along)
    slides = prismatic[:, None, None]
    modes = axis.new_zeros(len(axis), 4, 4, 4)
    modes[:, 0, :3, :3] = torch.where(slides, eye, along)
    modes[:, 1, :3, :3] = torch.where(slides, 0.0, eye - along)
    modes[:, 2, :3, :3] = torch.where(slides, 0.0, cross)
    modes[:, 3, :3, 3] = torch.where(prismatic[:, None], axis, 0.0)
    modes[:, 0, 3, 3] = 1.0
    return origin[:, None] @ modes


def twist(pose: Tensor, target: Tensor) -> Tensor:
    """Return the motion ``[..., 6]`` (m and rad, in world axes) that takes ``pose [..., 4, 4]`` to ``target``.

    No gradient flows through its rotation.
    """
    from scipy.spatial.transform import Rotation

    turn = (target[..., :3, :3] @ pose[..., :3, :3].mT).detach()
    rotation = Rotation.from_matrix(turn.reshape(-1, 3, 3).cpu().double().numpy()).as_rotvec()
    rotation = torch.as_tensor(rotation).to(turn).reshape(turn.shape[:-1])
    return torch.cat([target[..., :3, 3] - pose[..., :3, 3], rotation], dim=-1)


def check_rigid(name: str, pose: Tensor) -> None:
    """Refuse poses ``[..., 4, 4]`` that scale, shear, mirror or project.

    Raises:
        InvalidInput: a pose is not rigid.
    """
    rotation = pose[..., :3, :3]
    eye = torch.eye(4, dtype=pose.dtype, device=pose.device)
    rigid = (rotation @ rotation.mT - eye[:3, :3]).abs().amax() < 1e-5
    if not bool(pose.isfinite().all() & rigid & (rotation.det() > 0).all() & (pose[..., 3, :] == eye[3]).all()):
        expected = "a rotation, a position and a last row (0, 0, 0, 1)"
        raise InvalidInput(f"{name} is not a rigid pose", expected=expected, remedy="orthonormalise its rotation")
