"""Formulas of rigid motion that the files of this package share."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchcloth.errors import InvalidInput


def origin_matrix(xyz: Sequence[float], rpy: Sequence[float]) -> Tensor:
    """``[4, 4]`` float64 matrix of a URDF origin: roll, pitch, yaw about fixed axes, that is R = Rz Ry Rx."""
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
    """``[J, 4, 4, 4]``: the pose of joint j is modes[j] applied to (1, cos q, sin q, q), which is exact for every type.

    Rodrigues: R = a a' + cos q (I - a a') + sin q [a]x for a revolute joint; a translation q a for a prismatic one.
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
    """``[..., 6]`` m and rad: the motion in world axes that takes ``pose [..., 4, 4]`` to ``target``."""
    turn = target[..., :3, :3] @ pose[..., :3, :3].mT
    odd = 0.5 * (turn - turn.mT)
    sine = torch.stack([odd[..., 2, 1], odd[..., 0, 2], odd[..., 1, 0]], dim=-1)
    cosine = 0.5 * (turn.diagonal(dim1=-2, dim2=-1).sum(-1, keepdim=True) - 1)
    length = sine.norm(dim=-1, keepdim=True)
    angle = torch.atan2(length, cosine)
    little = length <= 1e-6
    rotation = sine * torch.where(little, 1.0, angle / length)
    half = (little & (cosine <= 0))[..., 0]
    if bool(half.any()):  # half a turn: the sine vanishes and any column of turn + I shows the axis
        column = (turn[half] + torch.eye(3, dtype=turn.dtype, device=turn.device)).mT
        axis = column[torch.arange(len(column)), column.norm(dim=-1).argmax(-1)]
        rotation[half] = axis / axis.norm(dim=-1, keepdim=True) * angle[half]
    return torch.cat([target[..., :3, 3] - pose[..., :3, 3], rotation], dim=-1)


def check_rigid(name: str, pose: Tensor) -> None:
    """Refuses poses ``[..., 4, 4]`` that scale, shear, mirror or project."""
    rotation = pose[..., :3, :3]
    eye = torch.eye(4, dtype=pose.dtype, device=pose.device)
    rigid = (rotation @ rotation.mT - eye[:3, :3]).abs().amax() < 1e-5
    if not bool(pose.isfinite().all() & rigid & (rotation.det() > 0).all() & (pose[..., 3, :] == eye[3]).all()):
        expected = "a rotation, a position and a last row (0, 0, 0, 1)"
        raise InvalidInput(f"{name} is not a rigid pose", expected=expected, remedy="orthonormalise its rotation")
