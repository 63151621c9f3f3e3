"""Boundaries: each takes the velocities that it finds and gives those that obey it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ...boundaries import AbstractBoundary, Grasp
from ..lowering import Lowering, Unfused
from ..program import Field


def lower(low: Lowering, name: str, boundary: AbstractBoundary, before: Field) -> Field:
    """Add a boundary to the program; returns the velocities after it."""
    part = _BOUNDARIES.get(type(boundary))
    if part is None:
        raise Unfused(f"boundary {name!r} ({type(boundary).__name__})")
    return part(low, name, boundary, before)


def copied(low: Lowering, before: Field) -> Field:
    """A field of its own with the same velocities."""
    after = low.program.temporary(low.vertices, 3)
    loop = low.loop(low.vertices)
    loop.put(loop.call("copy3", loop.load(before)), after)
    return after


def _grasp(low: Lowering, name: str, grasp: Grasp, before: Field) -> Field:
    if name not in low.drives or not any(low.closed[name]):
        return before
    if not all(low.closed[name]):
        raise Unfused(f"boundary {name!r} (a grasp that opens within an interval)")
    after = copied(low, before)
    index = low.program.table(grasp.index.cpu())
    loop = low.loop(len(grasp.index))
    x, increment, pose = loop.load(low.x.now, index), *(loop.load(field) for field in low.drives[name])
    held = loop.call("grasp", increment, loop.load(low.dt), x)
    loop.put(held, after, index)
    mass, free = loop.load(low.mass, index), loop.load(before, index)
    loop.add(loop.call("impulse", mass, free, held, x, increment, pose), low.impulses[name])
    return after


_BOUNDARIES: dict[type, Callable[[Lowering, str, Any, Field], Field]] = {Grasp: _grasp}
