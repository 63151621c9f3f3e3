"""A serial arm as a differentiable torch module: forward and inverse kinematics, motions and solids."""

from __future__ import annotations

import math
import warnings
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchcloth._utils.torch_modes import disable_autocast
from torchcloth._utils.vectors import check_is_not_half
from torchcloth.errors import InvalidInput, TorchclothError
from torchcloth.types import Trajectory

from . import inverse, trajectories
from .chain import SerialChain
from .description import Description, list_models, locate_urdf, read_description
from .link_meshes import MeshShape, read_link_mesh
from .rigid import check_rigid

# Flexiv's own home posture (flange pointing down), the same for every Rizon; it is no part of a URDF.
RIZON_HOME = (0.0, -0.69813, 0.0, 1.570796, 0.0, 0.69813, 0.0)


class Primitive(NamedTuple):
    """A solid of the arm, for drawings, clearance and occlusion.

    Attributes:
        kind: "box", "cylinder", "sphere" or "mesh".
        size: m; box: edges x, y, z; cylinder: radius, length along z; sphere: radius; mesh: extents along x, y, z.
        pose: [..., 4, 4] m, its centre in the world; of a mesh, the origin of its vertices.
        link: name of the link that it belongs to.
        mesh: vertices [V, 3] m and triangles [F, 3] of a closed surface, of a mesh only.
    """

    kind: str
    size: tuple[float, ...]
    pose: Tensor
    link: str
    mesh: tuple[np.ndarray, np.ndarray] | None = None


def load(
    name_or_path: str | Path,
    frame: str = "flange",
    base: Tensor | None = None,
    dtype: torch.dtype = torch.float64,
) -> Arm:
    """Load a robot arm.

    Args:
        name_or_path: one of ``list_models()`` or the path of a URDF file. Joints may be revolute, continuous, prismatic
            or fixed. Of a branched tree, the joints between the root and ``frame`` are used.
        frame: the link whose pose is computed. The Rizons have ``flange`` and, for the Flexiv Grav gripper,
            ``tcp_open`` and ``tcp_closed``: the point between the fingers, 0.150 and 0.200 m beyond the flange.
        base: ``[4, 4]`` m, pose of the robot's root link in the world; the identity by default. It may require grad.
        dtype: of every tensor of the arm.

    Raises:
        InvalidInput: unknown name or frame, unreadable file, or a mimic, planar or floating joint before ``frame``.
        MissingDependency: pytorch-kinematics is not installed.
    """
    path, shipped = locate_urdf(name_or_path), str(name_or_path) in list_models()
    model = str(name_or_path) if shipped else str(path.resolve())  # elsewhere a path from here may be another's
    home = RIZON_HOME if shipped else None
    return Arm(read_description(path, frame), model=model, frame=frame, base=base, home=home, dtype=dtype)


class Arm(SerialChain):
    """Kinematics of a robot arm, differentiable to any order in reverse and forward mode.

    Create one with ``load``. Joint positions ``q`` are ``[..., J]`` for J joints in the order of ``joint_names``: rad,
    or m for a prismatic joint. A ``q`` of another precision is converted to that of the arm.

    Attributes:
        name: of the robot.
        model: what it was loaded by: a name among ``list_models()``, or the path of a URDF file.
        frame: the link whose pose is computed.
        joint_names: the names of the J joints, root first.
        joint_types: ``revolute``, ``continuous`` or ``prismatic``, one for each joint.
        base: ``[4, 4]`` m, pose of the root link in the world.
        home: ``[J]`` a posture to start from: the vendor's for a Rizon, else zero brought inside the soft limits.
    """

    home: Tensor
    _shape_pose: Tensor

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
        root = torch.eye(4, dtype=torch.float64) if base is None else _validate_base(base, dtype)
        super().__init__(description, root, dtype)
        self.model, self.frame = model or description.name, frame
        self._shapes, self._mesh_shapes, self._folder = description.shapes, description.mesh_shapes, description.folder
        joints = len(self.joint_names)  # fewer than the vendor's if the frame is not the last link
        posture = torch.tensor((home or [0.0] * joints)[:joints], dtype=torch.float64)
        buffers = {
            "home": posture.clamp(description.limits[2], description.limits[3]),
            "_shape_pose": torch.stack(
                [torch.eye(4, dtype=torch.float64), *(s.pose for s in (*self._shapes, *self._mesh_shapes))]
            )[1:],
        }
        for key, value in buffers.items():
            self.register_buffer(key, value.to(dtype), persistent=False)

    @property
    def solid_joints(self) -> tuple[int, ...]:
        """Numbers of the joints that move the primitive solids, counted from 1; 0 for solids of the root."""
        return tuple(shape.body for shape in self._shapes)

    @property
    def links_without_primitives(self) -> tuple[str, ...]:
        """Names of the links with a solid that is a mesh, whose distances to others are not computed."""
        return tuple(dict.fromkeys(shape.link for shape in self._mesh_shapes))

    @property
    def unread_meshes(self) -> dict[str, str]:
        """By link, why the mesh of a solid cannot be read; ``geometry`` leaves such solids out."""
        return self._link_meshes[1]

    @cached_property
    def _link_meshes(self) -> tuple[list[tuple[int, MeshShape, tuple[np.ndarray, np.ndarray]]], dict[str, str]]:
        """Meshes that could be read with their numbers, and why others could not, by link."""
        meshes, faults = [], {}
        for number, shape in enumerate(self._mesh_shapes):
            try:
                meshes.append((number, shape, read_link_mesh(shape.file, self._folder, shape.scale)))
            except TorchclothError as error:
                faults.setdefault(shape.link, str(error))
        return meshes, faults

    def extra_repr(self) -> str:
        """Return name, frame and joints, for ``print(arm)``."""
        return f"{self.name!r}, frame={self.frame!r}, joints={list(self.joint_names)}"

    @disable_autocast()
    def forward(self, q: Tensor) -> Tensor:
        """Compute the pose of ``frame`` in the world.

        Args:
            q: ``[..., J]`` rad or m, joint positions.

        Returns:
            ``[..., 4, 4]`` m.

        Raises:
            InvalidInput: the last dimension of ``q`` is not J, or ``q`` is not floating.
        """
        return self.end_pose(self.body_poses(q))

    @disable_autocast()
    def jacobian(self, q: Tensor) -> Tensor:
        """Compute the geometric Jacobian at the origin of ``frame``, in world axes.

        Args:
            q: ``[..., J]`` rad or m, joint positions.

        Returns:
            ``[..., 6, J]``: linear velocity (m/s) above angular velocity (rad/s), for each unit of joint velocity.
        """
        return self.end_jacobian(self.body_poses(q))

    @disable_autocast()
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
        """Compute the poses that a cloth follows, for a motion through joint waypoints.

        The joints follow cubic Hermite curves with Catmull-Rom velocities (C1). Every waypoint is a sample, so the
        gripper opens and closes on time. The result is differentiable in ``q`` and ``t``.

        Args:
            q: ``[..., K, J]`` rad or m, joint waypoints, K >= 2.
            t: ``[K]`` s, their times.
            closed: ``[K]`` bool, the gripper holds the cloth from this waypoint until the next; always by default.
            period: s, the longest time between two samples.
            stop: ``[K]`` bool, the waypoints where the arm comes to rest; by default the first and the last. To stand
                still between two equal waypoints, stop at both.
            check_limits: refuse a motion beyond hard position limits or velocity limits (differences of samples).

        Returns:
            Trajectory with S samples: t ``[S]``, pose ``[..., S, 4, 4]``, closed ``[S]``.

        Raises:
            InvalidInput: sizes that do not match, times that do not increase, or a motion beyond the joints' limits.
        """
        q = self.validate_joints(q)
        check_is_not_half("t", t)
        t = torch.as_tensor(t).to(q)
        closed, stop = (None if mask is None else torch.as_tensor(mask) for mask in (closed, stop))
        trajectories.check_waypoints(q, t, closed=closed, stop=stop)
        sampled = trajectories.interpolate(q, t, stop, period)
        if check_limits:
            units = tuple("m" if kind == "prismatic" else "rad" for kind in self.joint_types)
            trajectories.check_limits(sampled, self.joint_names, units, self.limits)
        is_closed = torch.ones_like(t, dtype=torch.bool) if closed is None else closed.to(t.device)
        return Trajectory(sampled.t, self(sampled.q), is_closed[sampled.waypoint])

    @disable_autocast()
    def inverse(
        self,
        pose: Tensor,
        q0: Tensor | None = None,
        *,
        reference: Tensor | None = None,
        tolerance: float = 1e-5,
        iterations: int = 100,
    ) -> Tensor:
        """Compute joint positions inside the soft limits that bring ``frame`` to the given poses.

        The solver is damped least squares. Each pose starts from the solution of the one before it, so that a path of
        poses stays on one branch; the first pose also tries fixed random postures. Spare degrees of freedom are drawn
        to ``reference``. Every solution is verified by ``forward``. No gradient flows through the solver.

        Args:
            pose: ``[K, 4, 4]`` m in the world, or one ``[4, 4]``.
            q0: ``[J]`` where to start; ``home`` by default.
            reference: ``[J]`` the posture to stay close to; ``q0`` by default.
            tolerance: the largest error accepted, position (m) and rotation (rad) in one norm.
            iterations: the largest number of steps for one pose.

        Returns:
            ``[K, J]``, or ``[J]`` for one pose.

        Raises:
            InvalidInput: names the first pose that cannot be reached and the joints at their limits.
        """
        check_is_not_half("pose", pose)
        pose = torch.as_tensor(pose).detach().to(self.base)
        if pose.ndim not in (2, 3) or pose.shape[-2:] != (4, 4) or len(pose) == 0:
            raise InvalidInput("pose has the wrong shape", got=tuple(pose.shape), expected="(K, 4, 4) or (4, 4)")
        check_rigid("pose", pose)
        if not 0 < tolerance < math.inf:
            raise InvalidInput("tolerance", got=tolerance, expected="a finite value > 0")
        start = self.home if q0 is None else self._posture("q0", q0)
        target = start if reference is None else self._posture("reference", reference)
        poses = pose.reshape(-1, 4, 4)
        (q,) = inverse.solve_inverse_kinematics(self, poses[None], start[None], target[None], tolerance, iterations)
        if isinstance(q, Exception):
            raise q
        return q.reshape(*pose.shape[:-2], -1)

    @disable_autocast()
    def geometry(self, q: Tensor) -> list[Primitive]:
        """Return the boxes, cylinders, spheres and meshes of the links from the root to ``frame``.

        A link gives its collision shapes, or its visual ones if it has no others. A mesh that is not closed is replaced
        by its convex hull. A mesh that cannot be read is left out with a warning (``unread_meshes`` says why). With
        ``frame="tcp_closed"`` the gripper of a Rizon is included.

        Args:
            q: ``[..., J]`` rad or m, joint positions.
        """
        bodies = self.body_poses(q)
        solids = [
            Primitive(shape.kind, shape.size, bodies[..., shape.body, :, :] @ pose, shape.link)
            for shape, pose in zip(self._shapes, self._shape_pose, strict=False)
        ]
        meshes, faults = self._link_meshes
        for link, reason in faults.items():
            warnings.warn(f"solid of {link!r} is left out: {reason}", stacklevel=2)
        for number, shape, mesh in meshes:
            pose = bodies[..., shape.body, :, :] @ self._shape_pose[len(self._shapes) + number]
            solids.append(Primitive("mesh", tuple(np.ptp(mesh[0], axis=0).tolist()), pose, shape.link, mesh))
        return solids

    def _posture(self, name: str, q: Tensor) -> Tensor:
        q = torch.as_tensor(q)
        if q.ndim != 1:
            raise InvalidInput(
                f"{name} has the wrong shape", got=tuple(q.shape), expected=f"({len(self.joint_names)},)"
            )
        return self.validate_joints(q.detach(), name)


def _validate_base(base: Tensor, dtype: torch.dtype) -> Tensor:
    base = torch.as_tensor(base)
    check_is_not_half("base", base)
    if base.requires_grad and base.is_leaf and base.dtype != dtype:  # a copy follows no optimiser
        remedy = "use one precision: load(..., dtype=base.dtype), or base.double()"
        raise InvalidInput("base that is learned", got=base.dtype, expected=f"the arm's {dtype}", remedy=remedy)
    if base.shape != (4, 4) or not base.is_floating_point():
        got = f"{base.dtype} {tuple(base.shape)}"
        raise InvalidInput("base has the wrong shape or type", got=got, expected="floating (4, 4)")
    check_rigid("base", base.detach())
    return base
