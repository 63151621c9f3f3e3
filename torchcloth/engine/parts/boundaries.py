"""Boundaries: each takes the velocities that it finds and leaves those that obey it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import torch
from torch import Tensor

from ...boundaries import AbstractBoundary, AbstractCollider, Box, Capsule, Cylinder, Grasp, MeshSolid, Plane, Sphere
from ...effects import GripSlip
from ..fields import Field
from ..lowering import Lowering, Unfused
from ..shared_loops import Velocities
from . import points
from .body import Body


def lower(low: Lowering, name: str, boundary: AbstractBoundary, velocity: Velocities) -> None:
    """Add a boundary to the program, and what it gives if it is driven. dynamics.py, ``constrain``"""
    part = _BOUNDARIES.get(type(boundary))
    if part is None:
        raise Unfused(f"boundary {name!r} ({type(boundary).__name__})")
    velocity.before = velocity.now
    part(low, name, boundary, velocity)
    if name in low.drives:
        _slip(low, name, boundary, velocity)
        _report(low, name, velocity)


def _grasp(low: Lowering, name: str, grasp: Grasp, velocity: Velocities) -> None:
    if name not in low.drives:
        return
    loop, (increment, _, closed) = velocity.loop, low.drives[name]
    numbers = (increment, low.dt, _held(low, grasp.index), closed, low.x.now)
    velocity.now = loop.call("grasp", *(loop.load(field) for field in numbers), velocity.now)


def _collide(low: Lowering, name: str, solid: AbstractCollider, velocity: Velocities) -> None:
    body = Body(low, name, solid)
    if solid.points is not None:
        points.collide(low, solid.points, body, velocity)
    loop = velocity.loop
    velocity.now = loop.call("plus3", velocity.now, body.change(loop, loop.load(low.x.now), velocity.now))


def _held(low: Lowering, index: Tensor) -> Field:
    """1 for the vertices of a patch, 0 for the others: on all of them a loop need not be interrupted."""
    held = torch.zeros(low.vertices, 1)
    held[index.cpu()] = 1
    return low.program.constant(held)


def _slip(low: Lowering, name: str, boundary: AbstractBoundary, velocity: Velocities) -> None:
    for key, (effect, c) in low.model.effects.items():
        if effect.grasp != name:
            continue
        if type(effect) is not GripSlip:
            raise Unfused(f"effect {key!r} ({type(effect).__name__})")
        held, pull = _held(low, cast("Tensor", boundary.index)), low.program.temporary(1, 4)
        loop = velocity.loop
        parts = (loop.load(held), loop.load(low.mass), velocity.before, velocity.now)
        loop.add(loop.call("pull", *parts), pull)
        velocity.resume(velocity.store())
        loop, fields = velocity.loop, (pull, low.parameter(c.mobility), low.parameter(c.hold), low.dt)
        velocity.now = loop.call("creep", loop.load(held), velocity.now, *(loop.load(field) for field in fields))


def _report(low: Lowering, name: str, velocity: Velocities) -> None:
    """Impulse and its moment about the body."""
    loop, (increment, pose, _) = velocity.loop, low.drives[name]
    momentum = low.momentum(loop, loop.call("change", velocity.now, velocity.before))
    place = [loop.load(field) for field in (low.x.now, increment, pose)]
    loop.add(loop.call("impulse", momentum, *place), low.impulses[name])


_BOUNDARIES: dict[type, Callable[[Lowering, str, Any, Velocities], None]] = {
    Grasp: _grasp,
    **dict.fromkeys((Box, Capsule, Cylinder, MeshSolid, Plane, Sphere), _collide),
}
