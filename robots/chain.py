"""A serial kinematic chain as tensors: forward kinematics, the geometric Jacobian and the joint limits."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from torchcloth._utils.vectors import check_is_not_half
from torchcloth.errors import InvalidInput

from .description import Description
from .rigid import joint_modes


class JointLimits(NamedTuple):
    """Limits of each joint; infinite where the URDF gives none.

    Attributes:
        lower: [J] rad or m, hard lower limit.
        upper: [J] rad or m, hard upper limit.
        soft_lower: [J] rad or m, where the controller stops the arm; the hard limit if the URDF has no soft one.
        soft_upper: [J] rad or m, likewise.
        velocity: [J] rad/s or m/s.
        effort: [J] N m or N.
    """

    lower: Tensor
    upper: Tensor
    soft_lower: Tensor
    soft_upper: Tensor
    velocity: Tensor
    effort: Tensor


class SerialChain(nn.Module):
    """Bodies that hang on each other by one joint each.

    Joint positions ``q`` are ``[..., J]`` (rad, or m for a prismatic joint). A body is what moves with a joint.

    Args:
        description: numbers of the chain, float64.
        base: ``[4, 4]`` m, pose of the root link in the world; it may require grad.
        dtype: of every tensor of the chain.

    Attributes:
        name: of the robot.
        base: ``[4, 4]`` m, pose of the root link in the world.
        axis: ``[J, 3]``, unit vector of each joint in its own frame.
        joint_names: names of the J joints, root first.
        joint_types: ``revolute``, ``continuous`` or ``prismatic``, one for each joint.
    """

    base: Tensor
    axis: Tensor
    _modes: Tensor
    _tip: Tensor
    _limits: Tensor
    _prismatic: Tensor

    def __init__(self, description: Description, base: Tensor, dtype: torch.dtype) -> None:
        super().__init__()
        self.name = description.name
        self.joint_names, self.joint_types = description.joint_names, description.joint_types
        prismatic = torch.tensor([kind == "prismatic" for kind in self.joint_types])
        buffers = {
            "base": base,
            "axis": description.axis,
            "_modes": joint_modes(description.origin, description.axis, prismatic),
            "_tip": description.tip,
            "_limits": description.limits,
        }
        # Not in the state dict: a checkpoint must not turn one wrist generation into another.
        for key, value in buffers.items():
            self.register_buffer(key, value.to(dtype), persistent=False)
        self.register_buffer("_prismatic", prismatic, persistent=False)

    @property
    def limits(self) -> JointLimits:
        """Position, velocity and effort limits, ``[J]`` each."""
        return JointLimits(*self._limits)

    def validate_joints(self, q: Tensor, name: str = "q") -> Tensor:
        """Return joint positions ``[..., J]`` in the precision of the chain.

        Raises:
            InvalidInput: another number of joints, integers, or joints or a chain in half precision.
        """
        q = torch.as_tensor(q)  # recordings hold arrays
        joints = len(self.joint_names)
        if q.ndim == 0 or q.shape[-1] != joints or not q.is_floating_point():
            names = ", ".join(self.joint_names)
            got = f"{q.dtype} {tuple(q.shape)}"
            expected = f"floating (..., {joints}): {names}"
            raise InvalidInput(f"{name} has the wrong shape or type", got=got, expected=expected)
        if self.base.dtype not in (torch.float32, torch.float64):
            got = str(self.base.dtype).removeprefix("torch.")
            raise InvalidInput("precision of the arm", got=got, expected="float32 or float64", remedy="use arm.float()")
        check_is_not_half(name, q)
        return q.to(self.base)

    def body_poses(self, q: Tensor) -> Tensor:
        """Return the poses ``[..., J + 1, 4, 4]`` m of the root and of the body behind each joint, in the world."""
        q = self.validate_joints(q)
        basis = torch.stack([torch.ones_like(q), q.cos(), q.sin(), q], dim=-1)
        joints = torch.einsum("...jm,jmab->...jab", basis, self._modes)
        poses = [self.base.expand(*q.shape[:-1], 4, 4)]
        for joint in joints.unbind(-3):
            poses.append(poses[-1] @ joint)
        return torch.stack(poses, dim=-3)

    def end_pose(self, body_poses: Tensor) -> Tensor:
        """Return the pose ``[..., 4, 4]`` m of the end frame, from the body poses ``[..., J + 1, 4, 4]``."""
        return body_poses[..., -1, :, :] @ self._tip

    def end_jacobian(self, body_poses: Tensor) -> Tensor:
        """Return the geometric Jacobian ``[..., 6, J]`` of the end frame, from the body poses ``[..., J + 1, 4, 4]``.

        Rows are the linear velocity [m/s] and the angular velocity [rad/s] of the frame's origin, in world axes, per
        unit of joint velocity.
        """
        tip = self.end_pose(body_poses)[..., None, :3, 3]
        joint = body_poses[..., 1:, :, :]
        axis = (joint[..., :3, :3] @ self.axis[..., None])[..., 0]
        slides = self._prismatic[:, None]
        linear = torch.where(slides, axis, torch.linalg.cross(axis, tip - joint[..., :3, 3]))
        angular = torch.where(slides, 0.0, axis)
        return torch.cat([linear, angular], dim=-1).mT
