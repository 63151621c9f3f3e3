"""A serial arm as a differentiable torch module: forward and inverse kinematics, motions, geometry."""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torchcloth._utils.torch_modes import undisturbed
from torchcloth.errors import InvalidInput
from torchcloth.types import Trajectory

from . import inverse, trajectories
from .description import Description, describe, locate, models
from .rigid import check_rigid, joint_modes

# Flexiv's own home posture (flange pointing down), the same for every Rizon; it is no part of a URDF.
RIZON_HOME = (0.0, -0.69813, 0.0, 1.570796, 0.0, 0.69813, 0.0)


class Limits(NamedTuple):
    """What each joint may do (rad, m, s, N m, N); infinite where the URDF gives no limit."""

    lower: Tensor  # [J] rad or m, hard
    upper: Tensor  # [J] rad or m, hard
    soft_lower: Tensor  # [J] rad or m, where the controller stops the arm; the hard one where the URDF has no soft one
    soft_upper: Tensor  # [J] rad or m
    velocity: Tensor  # [J] rad/s or m/s
    effort: Tensor  # [J] N m or N


class Primitive(NamedTuple):
    """A solid of the arm, for drawing and for what a camera cannot see past."""

    kind: str  # "box", "cylinder" or "sphere"
    size: tuple[float, ...]  # m; box: edges x, y, z; cylinder: radius, length along z; sphere: radius
    pose: Tensor  # [..., 4, 4] m, its centre in the world
    link: str


def load(
    name_or_path: str | Path,
    frame: str = "flange",
    base: Tensor | None = None,
    dtype: torch.dtype = torch.float64,
) -> Arm:
    """Loads a robot arm.

    Args:
        name_or_path: one of ``models()`` or the path of a URDF file. Joints may be revolute, continuous, prismatic or
            fixed; of a branched tree, the joints on the way to ``frame`` are taken.
        frame: the link whose pose is computed. The Rizons have ``flange`` and, for the Flexiv Grav gripper,
            ``tcp_open`` and ``tcp_closed``: the point between the fingers, 0.150 and 0.200 m beyond the flange.
        base: ``[4, 4]`` m, pose of the robot's root link in the world; the identity by default. It may require grad.
        dtype: of every tensor of the arm.

    Raises:
        InvalidInput: unknown name or frame, unreadable file, a mimic, planar or floating joint on the way to ``frame``.
        MissingDependency: pytorch-kinematics is not installed.
    """
    path, shipped = locate(name_or_path), str(name_or_path) in models()
    model = str(name_or_path) if shipped else str(path.resolve())  # elsewhere a path from here may be another's
    home = RIZON_HOME if shipped else None
    return Arm(describe(path, frame), model=model, frame=frame, base=base, home=home, dtype=dtype)


class Arm(nn.Module):
    """Forward kinematics of a serial chain, differentiable to any order in reverse and forward mode.

    Use ``load`` to make one. ``q`` is always ``[..., J]`` with J joints in the order of ``joint_names``: rad, or m for
    a prismatic joint. A ``q`` of another precision is computed in that of the arm.

    Attributes:
        name: of the robot.
        model: what it was loaded by: a name among ``models()``, or the path of a URDF file.
        frame: the link whose pose is computed.
        joint_names: the names of the J joints, root first.
        joint_types: ``revolute``, ``continuous`` or ``prismatic``, one for each joint.
        base: ``[4, 4]`` m, pose of the root link in the world.
        home: ``[J]`` a posture to start from: the vendor's for a Rizon, else zero brought inside the soft limits.
    """

    base: Tensor
    home: Tensor
    _modes: Tensor
    _axis: Tensor
    _tip: Tensor
    _limits: Tensor
    _shape_pose: Tensor
    _prismatic: Tensor

    def __init__(
        self,
        description: Description,
        *,
        model: str = "",
        frame: str,
        base: Tensor | None = None,
        home: tuple[float, ...] | None = None,
        dtype: torch.dtype = torch.float64,
    ) -> None:
        super().__init__()
        self.name, self.model, self.frame = description.name, model or description.name, frame
        self.joint_names, self.joint_types = description.joint_names, description.joint_types
        self._shapes, self._unshaped = description.shapes, description.unshaped
        prismatic = torch.tensor([kind == "prismatic" for kind in self.joint_types])
        joints = len(self.joint_names)  # fewer than the vendor's where the frame is not the last link
        posture = torch.tensor((home or [0.0] * joints)[:joints], dtype=torch.float64)
        buffers = {
            "base": torch.eye(4, dtype=torch.float64) if base is None else _checked_base(base, dtype),
            "home": posture.clamp(description.limits[2], description.limits[3]),
            "_modes": joint_modes(description.origin, description.axis, prismatic),
            "_axis": description.axis,
            "_tip": description.tip,
            "_limits": description.limits,
            "_shape_pose": torch.stack([torch.eye(4, dtype=torch.float64), *(s.pose for s in self._shapes)])[1:],
        }
        # Not in the state dict: a checkpoint must not turn one wrist generation into another.
        for key, value in buffers.items():
            self.register_buffer(key, value.to(dtype), persistent=False)
        self.register_buffer("_prismatic", prismatic, persistent=False)

    @property
    def bodies(self) -> tuple[int, ...]:
        """Which joint moves each solid of ``geometry``, counted from 1; 0 for those of the root."""
        return tuple(shape.body for shape in self._shapes)

    @property
    def unshaped(self) -> tuple[str, ...]:
        """Links whose solids are meshes alone, which ``geometry`` leaves out."""
        return self._unshaped

    @property
    def limits(self) -> Limits:
        """Position, velocity and effort limits, ``[J]`` each."""
        return Limits(*self._limits)

    def extra_repr(self) -> str:
        """Name, frame and joints, for ``print(arm)``."""
        return f"{self.name!r}, frame={self.frame!r}, joints={list(self.joint_names)}"

    @undisturbed()
    def forward(self, q: Tensor) -> Tensor:
        """Pose of ``frame`` in the world.

        Args:
            q: ``[..., J]`` rad or m, joint positions.

        Returns:
            ``[..., 4, 4]`` m.

        Raises:
            InvalidInput: the last dimension of ``q`` is not J, or ``q`` is not floating.
        """
        return self._tips(self._bodies(q))

    def _tips(self, bodies: Tensor) -> Tensor:
        return bodies[..., -1, :, :] @ self._tip

    def _bodies(self, q: Tensor) -> Tensor:
        """Poses ``[..., J + 1, 4, 4]`` of the root and of the body behind each joint, in the world."""
        q = self.checked(q)
        basis = torch.stack([torch.ones_like(q), q.cos(), q.sin(), q], dim=-1)
        joints = torch.einsum("...jm,jmab->...jab", basis, self._modes)
        bodies = [self.base.expand(*q.shape[:-1], 4, 4)]
        for joint in joints.unbind(-3):
            bodies.append(bodies[-1] @ joint)
        return torch.stack(bodies, dim=-3)

    @undisturbed()
    def jacobian(self, q: Tensor) -> Tensor:
        """Geometric Jacobian at the origin of ``frame``, in world axes.

        Args:
            q: ``[..., J]`` rad or m, joint positions.

        Returns:
            ``[..., 6, J]``: linear velocity (m/s) above angular velocity (rad/s), for each unit of joint velocity.
        """
        return self._jacobian(self._bodies(q))

    def _jacobian(self, bodies: Tensor) -> Tensor:
        tip = self._tips(bodies)[..., None, :3, 3]
        joint = bodies[..., 1:, :, :]
        axis = (joint[..., :3, :3] @ self._axis[..., None])[..., 0]
        slides = self._prismatic[:, None]
        linear = torch.where(slides, axis, torch.linalg.cross(axis, tip - joint[..., :3, 3]))
        angular = torch.where(slides, 0.0, axis)
        return torch.cat([linear, angular], dim=-1).mT

    @undisturbed()
    def motion(
        self,
        q: Tensor,
        t: Tensor,
        closed: Tensor | None = None,
        period: float = 0.01,
        *,
        stop: Tensor | None = None,
        check_limits: bool = True,
    ) -> Trajectory:
        """A motion through joint waypoints, as the poses that a cloth follows.

        The joints follow cubic Hermite curves with Catmull-Rom velocities (C1). Every waypoint is a sample, so the
        gripper opens and closes on time. Differentiable in ``q`` and ``t``.

        Args:
            q: ``[..., K, J]`` rad or m, joint waypoints, K >= 2.
            t: ``[K]`` s, their times.
            closed: ``[K]`` bool, the gripper holds the cloth from this waypoint until the next; always by default.
            period: s, the longest time between two samples.
            stop: ``[K]`` bool, the waypoints where the arm comes to rest; by default the first and the last.
                To stand still between two equal waypoints, stop at both.
            check_limits: refuse a motion beyond hard position limits or velocity limits (differences of samples).

        Returns:
            Trajectory with S samples: t ``[S]``, pose ``[..., S, 4, 4]``, closed ``[S]``.

        Raises:
            InvalidInput: sizes that do not match, times that do not increase, a motion that the joints cannot do.
        """
        q = self.checked(q)
        t = torch.as_tensor(t).to(q)
        closed, stop = (None if mask is None else torch.as_tensor(mask) for mask in (closed, stop))
        trajectories.check_waypoints(q, t, closed=closed, stop=stop)
        sampled = trajectories.interpolate(q, t, stop, period)
        if check_limits:
            units = tuple("m" if kind == "prismatic" else "rad" for kind in self.joint_types)
            trajectories.check_limits(sampled, self.joint_names, units, self._limits)
        held = torch.ones_like(t, dtype=torch.bool) if closed is None else closed.to(t.device)
        return Trajectory(sampled.t, self(sampled.q), held[sampled.waypoint])

    @undisturbed()
    def inverse(
        self,
        pose: Tensor,
        q0: Tensor | None = None,
        *,
        reference: Tensor | None = None,
        tolerance: float = 1e-5,
        iterations: int = 100,
    ) -> Tensor:
        """Joint positions inside the soft limits that bring ``frame`` to the given poses.

        Damped least squares, each pose started from the solution before it, so that a path of poses stays on one
        branch; the first pose also tries fixed random postures. Spare freedom is pulled gently to ``reference``. Every
        answer is verified by ``forward``. A solver: no gradient flows through it.

        Args:
            pose: ``[K, 4, 4]`` m in the world, or one ``[4, 4]``.
            q0: ``[J]`` where to start; ``home`` by default.
            reference: ``[J]`` the posture to stay close to; ``q0`` by default.
            tolerance: the largest error accepted, position (m) and rotation (rad) in one norm.
            iterations: the most steps for one pose.

        Returns:
            ``[K, J]``, or ``[J]`` for one pose.

        Raises:
            InvalidInput: names the first pose that cannot be reached and the joints at their limits.
        """
        pose = torch.as_tensor(pose).detach().to(self.base)
        if pose.ndim not in (2, 3) or pose.shape[-2:] != (4, 4) or len(pose) == 0:
            raise InvalidInput("pose has the wrong shape", got=tuple(pose.shape), expected="(K, 4, 4) or (4, 4)")
        check_rigid("pose", pose)
        if not 0 < tolerance < math.inf:
            raise InvalidInput("tolerance", got=tolerance, expected="a finite value > 0")
        start = self.home if q0 is None else self._posture("q0", q0)
        target = start if reference is None else self._posture("reference", reference)
        poses = pose.reshape(-1, 4, 4)
        (q,) = inverse.solve(self, poses[None], start[None], target[None], tolerance, iterations)
        if isinstance(q, Exception):
            raise q
        return q.reshape(*pose.shape[:-2], -1)

    @undisturbed()
    def geometry(self, q: Tensor) -> list[Primitive]:
        """The boxes, cylinders and spheres of the links from the root to ``frame``.

        A link shows its collision shapes, or its visual ones if it has no others; meshes are left out. Choose
        ``frame="tcp_closed"`` to see a Rizon's gripper too.

        Args:
            q: ``[..., J]`` rad or m, joint positions.
        """
        bodies = self._bodies(q)
        return [
            Primitive(shape.kind, shape.size, bodies[..., shape.body, :, :] @ pose, shape.link)
            for shape, pose in zip(self._shapes, self._shape_pose, strict=True)
        ]

    def _posture(self, name: str, q: Tensor) -> Tensor:
        q = torch.as_tensor(q)
        if q.ndim != 1:
            raise InvalidInput(
                f"{name} has the wrong shape", got=tuple(q.shape), expected=f"({len(self.joint_names)},)"
            )
        return self.checked(q.detach(), name)

    def checked(self, q: Tensor, name: str = "q") -> Tensor:
        """Joint positions ``[..., J]`` in the arm's precision.

        Raises:
            InvalidInput: as many joints as it has not, whole numbers, or an arm in half precision.
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
        return q.to(self.base)


def _checked_base(base: Tensor, dtype: torch.dtype) -> Tensor:
    base = torch.as_tensor(base)
    if base.requires_grad and base.is_leaf and base.dtype != dtype:  # a copy follows no optimiser
        remedy = "make both alike: load(..., dtype=base.dtype), or base.double()"
        raise InvalidInput("base that is learned", got=base.dtype, expected=f"the arm's {dtype}", remedy=remedy)
    if base.shape != (4, 4) or not base.is_floating_point():
        got = f"{base.dtype} {tuple(base.shape)}"
        raise InvalidInput("base has the wrong shape or type", got=got, expected="floating (4, 4)")
    check_rigid("base", base.detach())
    return base
