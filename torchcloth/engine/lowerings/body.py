"""Solid bodies: the response of ``boundaries/collider.py`` to what touches them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from ...boundaries import AbstractCollider, Coulomb, Elliptic, Stribeck
from ..fields import Field
from ..loops import Loop
from ..lowering import Lowering, Unfused
from . import solids


class Body:
    """A collider in a program; its methods add to a loop.

    Attributes:
        steep: how much its distance may change along a way of length 1.
        limits: [2] offset and recovery.
    """

    def __init__(self, low: Lowering, name: str, solid: AbstractCollider) -> None:
        law = _LAWS.get(type(solid.friction))
        if law is None:
            raise Unfused(f"boundary {name!r} (friction {type(solid.friction).__name__})")
        self._low, self._distance, self.steep = low, solids.distance(low, solid), solids.steepness(solid)
        self._law, *self._numbers = law(low, solid.friction)
        self.limits = low.program.constant(torch.tensor([[solid.offset, solid.recovery]], dtype=low.program.dtype))
        self._place = _place(low, name, solid)

    def seen(self, loop: Loop, x: list[int]) -> tuple[list[int], list[int] | None]:
        """(distance and normal, in the body's axes; material velocity of the body, None: it stands still)."""
        if self._place is None:
            return self._distance(loop, x), None
        placed = loop.call("place", x, *(loop.load(field) for field in (*self._place, self._low.dt)))
        return self._distance(loop, placed[:3]), placed[3:]

    def change(self, loop: Loop, x: list[int], v: list[int], air: list[int]) -> list[int]:
        """Change of the velocities ``v`` at ``x``, exactly 0 where nothing touches; ``air`` per own mass goes along."""
        contact, own = self.seen(loop, x)
        if self._place is None or own is None:
            return self._response(loop, v, contact, air)
        pose = loop.load(self._place[1])
        air = air and loop.call("tensor_inwards", air, pose)
        return loop.call("outwards", self._response(loop, loop.call("inwards", v, own, pose), contact, air), pose)

    def _response(self, loop: Loop, slip: list[int], contact: list[int], air: list[int]) -> list[int]:
        numbers = [loop.load(field) for field in (self._low.dt, self.limits, *self._numbers)]
        law = f"{self._law}_in_air" if air else self._law
        return loop.call(law, slip, contact, *numbers, air)


def _place(low: Lowering, name: str, solid: AbstractCollider) -> tuple[Field, Field] | None:
    """(increment, pose) of the shape; None when it stands still where it was given."""
    own = None if solid.pose is None else low.program.constant(solid.pose.reshape(1, 16))
    if name not in low.drives:
        still = low.program.constant(torch.eye(4).reshape(1, 16))
        return None if own is None else (still, own)
    increment, pose, _ = low.drives[name]
    if own is None:
        return increment, pose
    loop, composed = low.program.first(), low.program.temporary(1, 16)
    loop.put(loop.call("compose", loop.load(pose), loop.load(own)), composed)
    return increment, composed


def _coulomb(low: Lowering, friction: Coulomb) -> tuple[Any, ...]:
    return "coulomb", low.parameter(friction.field)


def _stribeck(low: Lowering, friction: Stribeck) -> tuple[Any, ...]:
    return "stribeck", *(low.parameter(part.field) for part in (friction, friction.excess, friction.speed))


def _elliptic(low: Lowering, friction: Elliptic) -> tuple[Any, ...]:
    axis = low.program.constant(friction.axis.reshape(1, 3))
    return "elliptic", low.parameter(friction.field), low.parameter(friction.ratio.field), axis


_LAWS: dict[type, Callable[[Lowering, Any], tuple[Any, ...]]] = {
    Coulomb: _coulomb,
    Elliptic: _elliptic,
    Stribeck: _stribeck,
}
