"""Boundaries: each takes the velocities that it finds and leaves those that obey it."""

from __future__ import annotations

from typing import Any, cast

from ...boundaries import AbstractCollider, Box, Capsule, Cylinder, Grasp, MeshSolid, Plane, Sphere
from ...effects import GripSlip
from ..fields import Field
from ..loops import Loop
from ..lowering import Lowering, Unfused
from ..shared_loops import Velocities
from . import points
from .body import Body


def lower(low: Lowering, velocity: Velocities) -> None:
    """Add all boundaries to the program, in order, and what the driven ones give. dynamics.py, ``constrain``"""
    parts = list(low.model.boundaries.items())
    for k, (name, boundary) in enumerate(parts):
        if type(boundary) is Grasp:
            field = velocity.leave(drift=all(type(other) is Grasp for _, other in parts[k:]))
            if name in low.drives:
                _grasp(low, name, boundary, velocity, field)
            continue
        if type(boundary) not in _SOLIDS:
            raise Unfused(f"boundary {name!r} ({type(boundary).__name__})")
        velocity.enter()
        velocity.before = velocity.now
        _collide(low, name, cast("AbstractCollider", boundary), velocity)
        if name in low.drives:
            _report(low, name, velocity.loop, None, velocity.before, velocity.now)


def _grasp(low: Lowering, name: str, grasp: Grasp, velocity: Velocities, field: Field) -> None:
    """On the held vertices alone, whose rows are overwritten; what they were is kept for the reverse sweep."""
    rows, count, (increment, _, closed) = low.program.table(grasp.index), len(grasp.index), low.drives[name]
    free = low.program.temporary(count, 3)
    loop = low.loop(count)
    loop.put(loop.load(field, rows), free)
    loop = low.loop(count)
    numbers = [loop.load(given) for given in (increment, low.dt, closed)]
    held = loop.call("grasp", *numbers, loop.load(low.x.now, rows), loop.load(free))
    for key, (effect, c) in low.model.effects.items():
        if effect.grasp != name:
            continue
        if type(effect) is not GripSlip:
            raise Unfused(f"effect {key!r} ({type(effect).__name__})")
        loop, held = _slip(low, rows, loop, free, held, c)
    _report(low, name, loop, rows, loop.load(free), held)
    velocity.overwrite(loop, rows, held)


def _collide(low: Lowering, name: str, solid: AbstractCollider, velocity: Velocities) -> None:
    body = Body(low, name, solid)
    if solid.points is not None:
        points.collide(low, solid.points, body, velocity)
    loop = velocity.loop
    change = body.change(loop, loop.load(low.x.now), velocity.now, low.air_per_own(loop))
    velocity.now = loop.call("plus3", velocity.now, change)


def _slip(low: Lowering, rows: int, loop: Loop, free: Field, held: list[int], c: Any) -> tuple[Loop, list[int]]:
    """(a new loop over the held vertices, their velocities in it)."""
    masses = [low.mass] if low.resistance is None else [low.mass, low.resistance]
    pull, *patch = (low.program.temporary(1, comps) for comps in (3, *(m.comps for m in masses)))
    still = low.program.temporary(free.rows, 3)
    loop.add(low.momentum(loop, loop.call("change", held, loop.load(free)), rows), pull)
    for own, total in zip(masses, patch, strict=True):
        loop.add(loop.load(own, rows), total)
    loop.put(held, still)
    loop = low.loop(free.rows)
    fields = (pull, *patch, low.parameter(c.mobility), low.parameter(c.hold), low.dt)
    law = "creep" if low.resistance is None else "creep_in_air"
    return loop, loop.call(law, loop.load(still), *(loop.load(field) for field in fields))


def _report(low: Lowering, name: str, loop: Loop, rows: int | None, before: list[int], after: list[int]) -> None:
    """Impulse and its moment about the body."""
    increment, pose, _ = low.drives[name]
    momentum = low.momentum(loop, loop.call("change", after, before), rows)
    place = loop.load(low.x.now, rows), loop.load(increment), loop.load(pose)
    loop.add(loop.call("impulse", momentum, *place), low.impulses[name])


_SOLIDS = (Box, Capsule, Cylinder, MeshSolid, Plane, Sphere)
