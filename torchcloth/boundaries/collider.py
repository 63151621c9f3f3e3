"""Solid bodies that cloth cannot enter: one response for all shapes."""

from __future__ import annotations

import math
from abc import abstractmethod
from typing import NamedTuple, TypedDict, cast

import torch
from torch import Tensor

from .._utils.linalg import rigid_displacement, dot, matvec, added_mass_correction
from .._utils.vectors import check_has_no_gradient
from ..errors import InvalidInput
from ..meshes import Mesh
from .base import AbstractBoundary, PrescribedMotion
from .friction import Coulomb
from .points import TrianglePoints

# Over the points on triangles in a substep. A cube's corner pushed into a sheet at 1 m/s, points every 5 mm, gets
# 5.1 mm deep with one pass, 2.8 with two, 1.7 with three and with six (between the points).
CONTACT_PASSES = 3


class ColliderOptions(TypedDict, total=False):
    """What all colliders take beside shape and friction; see ``AbstractCollider``."""

    moving: bool
    offset: float
    sampling: float | None
    recovery: float


class AbstractCollider(AbstractBoundary):
    """A body with a signed distance. Cloth stops at its surface, sticks and slips there by dry friction.

    A point may move along the normal only as far as the surface's tangent plane at the nearest place, carried along
    with the body to the end of the substep (Signorini's condition, linearised; exact for planes). The push that this
    needs feeds the friction, which acts on the slip against the body's material velocity. A point that is inside may
    not go deeper and is moved out at a bounded speed, so that a bad start adds little energy. Air that moves along with
    the cloth resists what stops it: without friction the impulse that cloth and air get together is along the surface's
    normal, and friction is mu times that, whatever part of it the air takes.

    Args:
        friction: mu [-] of Coulomb's law, or a law: ``Coulomb``, ``Stribeck``, ``Elliptic``.
        moving: the body follows ``motion[name]``, whose pose maps the coordinates in which the shape is given to the
            world (its ``closed`` flags mean nothing here); the layer reports the wrench. Otherwise it stands still and
            the shape is given in the world.
        offset: at which the cloth's middle surface is kept from the body [m], such as half its thickness.
        sampling: distance of contact points on the edges and triangles [m], for bodies that are smaller or sharper
            than the mesh's edges. None: vertices alone. Between points that are L apart cloth may cut L^2 / (8 r) deep
            into a surface of radius r and L / 3 into a sharp edge.
        recovery: speed at which points that are inside are moved out, at most [m/s].
        pose: [4, 4], the shape's own frame in the world, or in the body when it moves. None: no difference.

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
        """Signed distance [..., N, 1] m (negative inside) and outward unit normal [..., N, 3] at ``p`` [..., N, 3] m.

        In the shape's own coordinates. Finite everywhere, and so are the derivatives: at centres, axes and edges too.
        """

    def clearance(self, x: Tensor, pose: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Signed distance [..., N, 1] m and outward normal [..., N, 3] at world points ``x`` [..., N, 3] m.

        Args:
            x: positions.
            pose: [..., 4, 4], where a moving body is; None: its coordinates are the world's.
        """
        place = self._placed(None, pose)
        distance, normal = self.distance(place.inside(x))
        return distance, place.outwards(normal)

    def bind(self, mesh: Mesh) -> AbstractCollider:
        """Lay the contact points on the mesh."""
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
        """Stop what approaches; first the points on edges and triangles, then, exactly, the vertices.

        ``resistance`` [..., V, 3, 3] is the mass of the air that moves along, over the vertices' own; None: none does.
        ``mass`` [..., V, 1] of the vertices, in any unit; None: all have the same.
        """
        motion = (None, None) if prescribed is None else (d[..., substep, :, :] for d in (prescribed.increment, prescribed.pose))
        place = self._placed(*motion)
        if self.points is not None:
            air = None if added_mass_ratio is None else self.points.interpolate(added_mass_ratio.flatten(-2)).unflatten(-1, (3, 3))
            contact = self._contact(self.points.interpolate(x), dt, place, air)
            mass = torch.ones_like(v[..., :1]) if mass is None else mass
            for _ in range(CONTACT_PASSES):
                v = v + self.points.distribute(self._change(contact, self.points.interpolate(v)), mass)
        return v + self._change(self._contact(x, dt, place, added_mass_ratio), v)

    def _placed(self, increment: Tensor | None, pose: Tensor | None) -> _Place:
        own = self.pose
        return _Place(increment, own if pose is None else pose if own is None else pose @ own)

    def _contact(self, x: Tensor, dt: float, place: _Place, resistance: Tensor | None) -> _Contact:
        way = place.way(x)
        distance, normal = self.distance(place.inside(x if way is None else x + way))
        least = ((self.offset - distance) / dt).clamp(max=self.recovery)
        air = None if resistance is None else _Air.of(place.tensor_inwards(resistance), normal)
        return _Contact(place, None if way is None else way / dt, normal, least, air)

    def _change(self, contact: _Contact, v: Tensor) -> Tensor:
        """Change of velocity of points [..., N, 3], exactly 0 for those that are free."""
        place, own, normal, least, air = contact
        slip = place.inwards(v if own is None else v - own)
        approach = dot(slip, normal)
        push = (least - approach).clamp(min=0)
        slip = slip - approach * normal
        if air is None:
            return place.outwards(push * normal - self.friction.slip_reduction(slip, push) * slip)
        aside = push * air.aside
        slip = slip + aside
        taken = self.friction.slip_reduction(slip, push * air.pushed(slip))
        return place.outwards(push * normal + aside - taken * slip)

    def extra_repr(self) -> str:
        """One line of the data sheet."""
        sampled = "vertices" if self.sampling is None else f"points every {self.sampling:g} m"
        return f"{'moving' if self.is_prescribed else 'fixed'}, offset={self.offset:g} m, {sampled}"


class _Place(NamedTuple):
    """Where the shape is at the end of a substep; None for what makes no difference."""

    increment: Tensor | None  # [..., 4, 4] motion of the world points that the body carries along
    pose: Tensor | None  # [..., 4, 4] of the shape

    def way(self, x: Tensor) -> Tensor | None:
        """How far the body's motion carries world points; None: it stands still."""
        return None if self.increment is None else rigid_displacement(self.increment, x)

    def inside(self, x: Tensor) -> Tensor:
        """World points in the shape's coordinates."""
        if self.pose is None:
            return x
        away = x - self.pose[..., None, :3, 3]  # no matrix product: CUDA's may have ten bits, half a millimetre at 1 m
        return (away.unsqueeze(-1) * self.pose[..., None, :3, :3]).sum(-2)

    def inwards(self, v: Tensor) -> Tensor:
        """World vectors in the shape's axes."""
        return v if self.pose is None else v @ self.pose[..., :3, :3]

    def tensor_inwards(self, b: Tensor) -> Tensor:
        """World tensors [..., N, 3, 3] in the shape's axes."""
        if self.pose is None:
            return b
        turn = self.pose[..., None, :3, :3]
        return turn.mT @ b @ turn

    def outwards(self, v: Tensor) -> Tensor:
        """Vectors of the shape in world axes."""
        return v if self.pose is None else v @ self.pose[..., :3, :3].mT


class _Contact(NamedTuple):
    """What does not depend on the points' velocities."""

    place: _Place
    own: Tensor | None  # [..., N, 3] m/s, material velocity of the body, world axes; None: it stands still
    normal: Tensor  # [..., N, 3], the shape's axes
    least: Tensor  # [..., N, 1] m/s, normal velocity that the points must have at least, relative to the body
    air: _Air | None  # that moves along; None: there is none


class _Air(NamedTuple):
    """How points with air that moves along answer a push, in the shape's axes."""

    resistance: Tensor  # [..., N, 3, 3]
    aside: Tensor  # [..., N, 3], tangential, change of velocity with one of 1 along the normal: sheets give way aslant
    push: Tensor  # [..., N, 1], impulse per mass that such a change takes

    @classmethod
    def of(cls, resistance: Tensor, normal: Tensor) -> _Air:
        """W n = n - (1 + B)^-1 B n answers the impulse n: over n . W n, what changes the normal velocity by 1."""
        less = added_mass_correction(resistance, normal)
        along = dot(less, normal)
        push = 1 / (1 - along)
        return cls(resistance, push * (along * normal - less), push)

    def pushed(self, slip: Tensor) -> Tensor:
        """Push that counts for friction, of 1: as inertia along the normal is more, and along the slip [..., N, 3]."""
        squared = dot(slip, slip)
        along = dot(slip, matvec(self.resistance, slip))
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
