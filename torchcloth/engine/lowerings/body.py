"""Solid bodies: the response of ``boundaries/collider.py`` to the cloth that touches them."""

from __future__ import annotations

from typing import Any

import torch

from ...boundaries import AbstractCollider, Coulomb, Elliptic, Stribeck
from ..builder import SubstepBuilder, UnsupportedPart, lowering_of, lowers
from ..fields import Field
from ..loops import Loop
from . import solids


class BodyLowering:
    """A collider in a program; its methods add instructions to a loop.

    Attributes:
        lipschitz: Lipschitz constant of its distance function.
        limits: [2] offset [m] and recovery speed [m/s].
    """

    def __init__(self, builder: SubstepBuilder, name: str, solid: AbstractCollider) -> None:
        law = lowering_of(solid.friction)
        if law is None:
            raise UnsupportedPart(f"boundary {name!r} (friction {type(solid.friction).__name__})")
        self._builder, self._distance = builder, solids.distance_function(builder, solid)
        self.lipschitz = solids.lipschitz_constant(solid)
        self._law, *self._coefficients = law(builder, solid.friction)
        limits = torch.tensor([[solid.offset, solid.recovery]], dtype=builder.program.dtype)
        self.limits = builder.program.constant(limits)
        self._pose = _pose_fields(builder, name, solid)

    def distance_and_velocity(self, loop: Loop, x: list[int]) -> tuple[list[int], list[int] | None]:
        """Return (distance and normal in the body's axes, velocity of the body at ``x`` or None if it stands still)."""
        if self._pose is None:
            return self._distance(loop, x), None
        place = loop.call("to_body_frame", x, *(loop.load(field) for field in (*self._pose, self._builder.dt)))
        return self._distance(loop, place[:3]), place[3:]

    def velocity_change(self, loop: Loop, x: list[int], v: list[int], added_mass_ratio: list[int]) -> list[int]:
        """Return the change of the velocities ``v`` at ``x``, exactly 0 where nothing touches.

        ``added_mass_ratio``: added mass over own mass; [] without.
        """
        contact, body_velocity = self.distance_and_velocity(loop, x)
        if self._pose is None or body_velocity is None:
            return self._response(loop, v, contact, added_mass_ratio)
        pose = loop.load(self._pose[1])
        ratio = added_mass_ratio and loop.call("tensor_to_body", added_mass_ratio, pose)
        slip = loop.call("velocity_to_body", v, body_velocity, pose)
        return loop.call("rotate_to_world", self._response(loop, slip, contact, ratio), pose)

    def _response(self, loop: Loop, slip: list[int], contact: list[int], ratio: list[int]) -> list[int]:
        inputs = [loop.load(field) for field in (self._builder.dt, self.limits, *self._coefficients)]
        law = f"{self._law}_added_mass" if ratio else self._law
        return loop.call(law, slip, contact, *inputs, ratio)


def _pose_fields(builder: SubstepBuilder, name: str, solid: AbstractCollider) -> tuple[Field, Field] | None:
    """Fields (increment, pose) of the shape; None where it stands still in the world's axes."""
    shape_pose = None if solid.pose is None else builder.program.constant(solid.pose.reshape(1, 16))
    if name not in builder.prescribed:
        identity = builder.program.constant(torch.eye(4).reshape(1, 16))
        return None if shape_pose is None else (identity, shape_pose)
    increment, pose, _ = builder.prescribed[name]
    if shape_pose is None:
        return increment, pose
    loop, composed = builder.program.setup_loop(), builder.program.temporary(1, 16)
    loop.store(loop.call("compose_poses", loop.load(pose), loop.load(shape_pose)), composed)
    return increment, composed


@lowers(Coulomb)
def lower_coulomb(builder: SubstepBuilder, friction: Coulomb) -> tuple[Any, ...]:
    """Return the kernel of Coulomb friction and its coefficient."""
    return "coulomb", builder.parameter(friction.field)


@lowers(Stribeck)
def lower_stribeck(builder: SubstepBuilder, friction: Stribeck) -> tuple[Any, ...]:
    """Return (kernel, coefficient of fast slip, excess at rest, speed)."""
    return "stribeck", *(builder.parameter(part.field) for part in (friction, friction.excess, friction.speed))


@lowers(Elliptic)
def lower_elliptic(builder: SubstepBuilder, friction: Elliptic) -> tuple[Any, ...]:
    """Return (kernel, coefficient along the axis, ratio of the one across to it, axis)."""
    axis = builder.program.constant(friction.axis.reshape(1, 3))
    return "elliptic", builder.parameter(friction.field), builder.parameter(friction.ratio.field), axis
