"""Solid bodies that cloth cannot enter: the response that all shapes share."""

from __future__ import annotations

import math
from abc import abstractmethod
from typing import NamedTuple, TypedDict, cast

import torch
from torch import Tensor

from .._utils.linalg import added_mass_correction, dot, matvec, rigid_displacement
from .._utils.vectors import check_has_no_gradient
from ..errors import InvalidInput
from ..meshes import Mesh
from .base import AbstractBoundary, PrescribedMotion
from .friction import Coulomb
from .points import TrianglePoints

# Passes over the points on triangles in a substep. A cube's corner that is pushed into a sheet at 1 m/s, with points
# every 5 mm, gets 5.1 mm deep with one pass, 2.8 with two, 1.7 with three and with six (between the points).
CONTACT_PASSES = 3


class ColliderOptions(TypedDict, total=False):
    """Keyword arguments that all colliders share; see ``AbstractCollider``."""

    moving: bool
    offset: float
    sampling: float | None
    recovery: float


class AbstractCollider(AbstractBoundary):
    """A body with a signed distance. Cloth stops at its surface, sticks and slips there by dry friction.

    A point may move along the normal only up to the tangent plane at the nearest surface point, carried along with the
    body to the end of the substep (Signorini's condition, linearised; exact for planes). The impulse that this needs
    determines the friction, which acts on the slip against the body's material velocity. A point that is inside may not
    go deeper and is moved out at a bounded speed, so that a bad start adds little energy. Added mass of air resists
    what stops the cloth. Without friction the impulse on cloth and air together is along the surface's normal, and
    friction is mu times that impulse, whatever part of it the air takes.

    Args:
        friction: mu [-] of Coulomb's law, or a law: ``Coulomb``, ``Stribeck``, ``Elliptic``.
        moving: the body follows ``motion[name]``, whose pose maps the coordinates in which the shape is given to the
            world (its ``closed`` flags mean nothing here); the layer reports the wrench. Otherwise it stands still and
            the shape is given in the world.
        offset: distance between the cloth's middle surface and the body [m], such as half its thickness.
        sampling: distance of contact points on the edges and triangles [m], for bodies that are smaller or sharper
            than the mesh's edges. None: vertices alone. Between points at a distance L cloth may cut L^2 / (8 r) deep
            into a surface of radius r, and L / 3 into a sharp edge.
        recovery: largest speed at which points that are inside are moved out [m/s].
        pose: [4, 4], the shape's own frame in the world, or in the body when it moves. None: the identity.

    Raises:
        InvalidInput: a value outside its range.
    """

    def __init__(
        self,
        friction: float | Coulomb = 0.4,
        moving: bool = False,
        offset: float = 0.0,
        sampling: float | None = None,
        recovery: float = 0.2,
        pose: Tensor | None = None,
    ) -> None:
        super().__init__()
        if not 0 <= offset < math.inf:
            raise InvalidInput("offset", got=f"{offset:g} m", expected="a length >= 0")
        if sampling is not None and not 0 < sampling < math.inf:
            raise InvalidInput("sampling", got=f"{sampling:g} m", expected="a length > 0, or None")
        if not 0 < recovery < math.inf:
            raise InvalidInput("recovery", got=f"{recovery:g} m/s", expected="a speed > 0")
        self.friction = friction if isinstance(friction, Coulomb) else Coulomb(friction)
        self.is_prescribed = bool(moving)
        self.offset, self.sampling, self.recovery = float(offset), sampling, float(recovery)
        self.points: TrianglePoints | None = None
        self.register_buffer("pose", None if pose is None else _rigid(pose), persistent=False)
        self.pose: Tensor | None

    @abstractmethod
    def distance(self, p: Tensor) -> tuple[Tensor, Tensor]:
        """Compute signed distance and normal at points ``p`` [..., N, 3] m in the shape's own coordinates.

        Results and derivatives must be finite everywhere, also at centres, axes and edges.

        Returns:
            Signed distance [..., N, 1] m, negative inside, and outward unit normal [..., N, 3].
        """

    def clearance(self, x: Tensor, pose: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Compute signed distance [..., N, 1] m and outward normal [..., N, 3] at world points.

        Args:
            x: [..., N, 3] m.
            pose: [..., 4, 4], pose of a moving body; None: its coordinates are the world's.
        """
        frame = self._frame(None, pose)
        distance, normal = self.distance(frame.to_shape(x))
        return distance, frame.vectors_to_world(normal)

    def bind(self, mesh: Mesh) -> AbstractCollider:
        """Lay the contact points on the mesh, and return self."""
        if self.sampling is not None:
            self.points = TrianglePoints(mesh, self.sampling).to(self.friction.raw.device)
        return self

    def constrain(
        self,
        x: Tensor,
        v: Tensor,
        dt: float,
        prescribed: PrescribedMotion | None,
        substep: int,
        added_mass_ratio: Tensor | None = None,
        mass: Tensor | None = None,
    ) -> Tensor:
        """Stop what approaches the body: first points on edges and triangles, then, exactly, the vertices.

        Args:
            x: as for every boundary.
            v: as for every boundary.
            dt: as for every boundary.
            prescribed: as for every boundary.
            substep: as for every boundary.
            added_mass_ratio: [..., V, 3, 3], mass of the air that moves along over the vertices' own; None: no air.
            mass: [..., V, 1], vertex masses in any unit; None: all are equal.
        """
        increment = pose = None
        if prescribed is not None:
            increment, pose = prescribed.increment[..., substep, :, :], prescribed.pose[..., substep, :, :]
        frame = self._frame(increment, pose)
        if self.points is not None:
            ratio = added_mass_ratio
            ratio = None if ratio is None else self.points.interpolate(ratio.flatten(-2)).unflatten(-1, (3, 3))
            contact = self._contact(self.points.interpolate(x), dt, frame, ratio)
            mass = torch.ones_like(v[..., :1]) if mass is None else mass
            for _ in range(CONTACT_PASSES):
                change = self._velocity_change(contact, self.points.interpolate(v))
                v = v + self.points.distribute(change, mass)
        return v + self._velocity_change(self._contact(x, dt, frame, added_mass_ratio), v)

    def _frame(self, increment: Tensor | None, body_pose: Tensor | None) -> _ShapeFrame:
        pose = self.pose if body_pose is None else body_pose if self.pose is None else body_pose @ self.pose
        return _ShapeFrame(increment, pose)

    def _contact(self, x: Tensor, dt: float, frame: _ShapeFrame, added_mass_ratio: Tensor | None) -> _Contact:
        carried = frame.body_displacement(x)
        distance, normal = self.distance(frame.to_shape(x if carried is None else x + carried))
        min_speed = ((self.offset - distance) / dt).clamp(max=self.recovery)
        air = None
        if added_mass_ratio is not None:
            air = _AirResponse.to_impulse_along(frame.tensors_to_shape(added_mass_ratio), normal)
        return _Contact(frame, None if carried is None else carried / dt, normal, min_speed, air)

    def _velocity_change(self, contact: _Contact, v: Tensor) -> Tensor:
        """Return the change of velocity of points [..., N, 3], exactly 0 for those that are free."""
        frame, body_velocity, normal, min_speed, air = contact
        slip = frame.vectors_to_shape(v if body_velocity is None else v - body_velocity)
        approach = dot(slip, normal)
        push = (min_speed - approach).clamp(min=0)
        slip = slip - approach * normal
        if air is None:
            return frame.vectors_to_world(push * normal - self.friction.slip_reduction(slip, push) * slip)
        sideways = push * air.sideways
        slip = slip + sideways
        reduction = self.friction.slip_reduction(slip, push * air.friction_push(slip))
        return frame.vectors_to_world(push * normal + sideways - reduction * slip)

    def extra_repr(self) -> str:
        """Return the line of the data sheet: motion, offset and contact points."""
        sampled = "vertices" if self.sampling is None else f"points every {self.sampling:g} m"
        return f"{'moving' if self.is_prescribed else 'fixed'}, offset={self.offset:g} m, {sampled}"


class _ShapeFrame(NamedTuple):
    """Frame of the shape at the end of a substep; None stands for the identity.

    Attributes:
        increment: [..., 4, 4], motion of the world points that the body carries along during the substep.
        pose: [..., 4, 4], of the shape in the world.
    """

    increment: Tensor | None
    pose: Tensor | None

    def body_displacement(self, x: Tensor) -> Tensor | None:
        """Return how far the body's motion carries world points [..., N, 3] m; None: it stands still."""
        return None if self.increment is None else rigid_displacement(self.increment, x)

    def to_shape(self, x: Tensor) -> Tensor:
        """Return world points in the shape's coordinates."""
        if self.pose is None:
            return x
        offset = x - self.pose[..., None, :3, 3]
        # no matrix product: on CUDA it may have ten bits, which is half a millimetre at 1 m
        return (offset.unsqueeze(-1) * self.pose[..., None, :3, :3]).sum(-2)

    def vectors_to_shape(self, v: Tensor) -> Tensor:
        """Return world vectors in the shape's axes."""
        return v if self.pose is None else v @ self.pose[..., :3, :3]

    def tensors_to_shape(self, b: Tensor) -> Tensor:
        """Return world tensors [..., N, 3, 3] in the shape's axes."""
        if self.pose is None:
            return b
        rotation = self.pose[..., None, :3, :3]
        return rotation.mT @ b @ rotation

    def vectors_to_world(self, v: Tensor) -> Tensor:
        """Return vectors of the shape's axes in world axes."""
        return v if self.pose is None else v @ self.pose[..., :3, :3].mT


class _Contact(NamedTuple):
    """What does not depend on the points' velocities.

    Attributes:
        frame: the shape's frame.
        body_velocity: [..., N, 3] m/s, material velocity of the body in world axes; None: it stands still.
        normal: [..., N, 3], in the shape's axes.
        min_speed: [..., N, 1] m/s, smallest allowed velocity along the normal relative to the body.
        air: response of the added mass; None: no air.
    """

    frame: _ShapeFrame
    body_velocity: Tensor | None
    normal: Tensor
    min_speed: Tensor
    air: _AirResponse | None


class _AirResponse(NamedTuple):
    """How points with added mass respond to an impulse along the normal, in the shape's axes.

    Attributes:
        added_mass_ratio: [..., N, 3, 3].
        sideways: [..., N, 3], tangential change of velocity for a unit change along the normal. It is not zero, because
            the air has inertia along the sheet's normal only.
        push: [..., N, 1], impulse per mass for such a change.
    """

    added_mass_ratio: Tensor
    sideways: Tensor
    push: Tensor

    @classmethod
    def to_impulse_along(cls, added_mass_ratio: Tensor, normal: Tensor) -> _AirResponse:
        """Solve for the response: the impulse n changes the velocity by W n = n - (1 + B)^-1 B n.

        Divided by n . W n, it changes the normal velocity by 1.
        """
        correction = added_mass_correction(added_mass_ratio, normal)
        along = dot(correction, normal)
        push = 1 / (1 - along)
        return cls(added_mass_ratio, push * (along * normal - correction), push)

    def friction_push(self, slip: Tensor) -> Tensor:
        """Return the push that counts for friction per unit of push, [..., N, 1].

        Inertia along the normal makes it larger, inertia along the slip smaller.
        """
        squared = dot(slip, slip)
        along = dot(slip, matvec(self.added_mass_ratio, slip))
        return self.push / (1 + along / torch.where(squared > 0, squared, 1.0))


def _rigid(pose: Tensor) -> Tensor:
    check_has_no_gradient("pose", pose)
    try:
        matrix = torch.as_tensor(pose).detach().to(torch.get_default_dtype())
    except (TypeError, ValueError, RuntimeError):
        matrix = torch.zeros(0)
    if matrix.shape == (4, 4) and bool(torch.isfinite(matrix).all()):
        rotation, last = matrix[:3, :3], matrix[3]
        error = (rotation @ rotation.mT - torch.eye(3).to(matrix)).abs().max()
        straight = float(error) < 1e-5 and float(torch.linalg.det(rotation)) > 0
        if straight and last.tolist() == [0.0, 0.0, 0.0, 1.0]:
            return matrix
    raise InvalidInput("pose", got=cast("object", pose), expected="a rigid pose [R p; 0 1], shape [4, 4], in metres")
