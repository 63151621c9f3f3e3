"""Spheres, boxes, capsules and cylinders, with closed-form distances."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Unpack

import torch
from torch import Tensor

from .._utils.linalg import cross, dot, safe_norm
from .._utils.vectors import parse_vector
from ..errors import InvalidInput
from ..parameters import PhysicalParameter
from .collider import AbstractCollider, ColliderOptions
from .friction import Coulomb, check_scalar, per_point


class Sphere(AbstractCollider):
    """A ball with a learnable radius.

    Args:
        radius: [m], learnable after ``radius.requires_grad_()``.
        centre: [3] m.
        friction: Coulomb coefficient >= 0, or a law.
        options: as for every collider (``AbstractCollider``).

    Raises:
        InvalidInput: a radius that is not positive.
    """

    world_facts = ("radius",)

    def __init__(
        self,
        radius: float,
        centre: Sequence[float] = (0.0, 0.0, 0.0),
        friction: float | Coulomb = 0.4,
        **options: Unpack[ColliderOptions],
    ) -> None:
        super().__init__(friction, **options)
        self.radius = PhysicalParameter(radius, "m", name="radius").requires_grad_(False)
        check_scalar("radius", self.radius)
        self.register_buffer("centre", parse_vector("centre", centre), persistent=False)
        self.register_buffer("up", parse_vector("up", (0.0, 0.0, 1.0)), persistent=False)
        self.centre: Tensor
        self.up: Tensor

    def distance(self, p: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the distance to the surface; the normal at the centre is the z axis."""
        length, normal = _polar(p - self.centre, self.up)
        return length - per_point(self.radius.value), normal


class Box(AbstractCollider):
    """A rectangular block with learnable edge lengths.

    Args:
        size: [3] m, edge lengths along its own axes, learnable after ``size.requires_grad_()``.
        pose: [4, 4], of the block's centre and axes in the world, or in the body when it moves. None: the origin.
        friction: Coulomb coefficient >= 0, or a law.
        options: as for every collider (``AbstractCollider``).

    Raises:
        InvalidInput: sizes that are not three positive lengths, or a pose that is not rigid.
    """

    world_facts = ("size",)

    def __init__(
        self,
        size: Sequence[float],
        pose: Tensor | None = None,
        friction: float | Coulomb = 0.4,
        **options: Unpack[ColliderOptions],
    ) -> None:
        super().__init__(friction, pose=pose, **options)
        self.size = PhysicalParameter(parse_vector("box size", size), "m", name="box size").requires_grad_(False)

    def distance(self, p: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the distance to the nearest face, edge or corner."""
        half = self.size.value.unsqueeze(-2) / 2
        distance, part = _block_distance(p.abs() - half)
        return distance, torch.where(p < 0, -part, part)


class _Axial(AbstractCollider):
    """A solid with an axis and a radius."""

    world_facts = ("radius",)

    def __init__(
        self,
        start: Sequence[float],
        end: Sequence[float],
        radius: float,
        friction: float | Coulomb = 0.4,
        **options: Unpack[ColliderOptions],
    ) -> None:
        super().__init__(friction, **options)
        a, b = parse_vector("start", start), parse_vector("end", end)
        if not float((b - a).norm()) > 0:
            raise InvalidInput("axis", got=f"from {start} to {end}", expected="two different points")
        self.radius = PhysicalParameter(radius, "m", name="radius").requires_grad_(False)
        check_scalar("radius", self.radius)
        self.register_buffer("start", a, persistent=False)
        self.register_buffer("end", b, persistent=False)
        perpendicular = cross(b - a, torch.eye(3).to(a)[(b - a).abs().argmin()])
        self.register_buffer("perpendicular", perpendicular / perpendicular.norm(), persistent=False)
        self.start: Tensor
        self.end: Tensor
        self.perpendicular: Tensor  # [3], a unit vector perpendicular to the axis


class Capsule(_Axial):
    """All points within ``radius`` of a segment: a cylinder with round ends.

    Args:
        start: [3] m, one end of the segment.
        end: [3] m, the other.
        radius: [m], learnable after ``radius.requires_grad_()``.
        friction: Coulomb coefficient >= 0, or a law.
        options: as for every collider (``AbstractCollider``).

    Raises:
        InvalidInput: a radius that is not positive, or a segment without length.
    """

    def distance(self, p: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the distance to the surface; on the segment the normal is some perpendicular."""
        axis = self.end - self.start
        along = (dot(p - self.start, axis) / dot(axis, axis)).clamp(0, 1)
        length, normal = _polar(p - self.start - along * axis, self.perpendicular)
        return length - per_point(self.radius.value), normal


class Cylinder(_Axial):
    """A round bar with flat ends.

    Args:
        start: [3] m, centre of one end.
        end: [3] m, centre of the other.
        radius: [m], learnable after ``radius.requires_grad_()``.
        friction: Coulomb coefficient >= 0, or a law.
        options: as for every collider (``AbstractCollider``).

    Raises:
        InvalidInput: a radius that is not positive, or a cylinder without length.
    """

    def distance(self, p: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the distance to barrel, end or rim; on the axis the barrel's normal is some perpendicular."""
        length = (self.end - self.start).norm()
        axis = (self.end - self.start) / length
        q = p - (self.start + self.end) / 2
        height = dot(q, axis)
        radial, outwards = _polar(q - height * axis, self.perpendicular)
        gaps = torch.broadcast_tensors(radial - per_point(self.radius.value), height.abs() - length / 2)
        distance, part = _block_distance(torch.cat(gaps, dim=-1))
        side, top = part.split(1, dim=-1)
        return distance, side * outwards + torch.where(height < 0, -top, top) * axis


def _polar(q: Tensor, fallback: Tensor) -> tuple[Tensor, Tensor]:
    """Return length [..., 1] and unit vector [..., 3]; the fallback where there is no direction."""
    length = safe_norm(q)
    zero = length == 0
    return length, torch.where(zero, fallback, q / torch.where(zero, 1.0, length))


def _block_distance(gap: Tensor) -> tuple[Tensor, Tensor]:
    """Return the signed distance [..., 1] to a block, and the absolute components [..., K] of its normal.

    ``gap`` holds the signed distances [..., K] to the block's pairs of parallel sides.
    """
    nearest, side = gap.max(-1, keepdim=True)
    outside, part = _polar(gap.clamp(min=0), torch.zeros_like(gap).scatter(-1, side, 1.0))
    return torch.where(outside > 0, outside, nearest), part
