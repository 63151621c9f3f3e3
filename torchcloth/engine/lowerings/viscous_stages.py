"""Viscous forces in stages."""

from __future__ import annotations

from ...boundaries import Grasp
from ...dynamics.viscous_stages import PEAK, Polynomial
from ..fields import Field
from ..loops import Loop
from ..lowering import Lowering


def relaxed(low: Lowering) -> tuple[Loop, list[int]]:
    """A loop over the vertices, and in it their velocities after what the parts put into ``low.viscous``."""
    if not low.viscous:
        loop = low.loop(low.vertices)
        return loop, loop.load(low.v.now)
    first, slope = Polynomial.of(low.model.stages)
    none, held = low.program.constant([[0.0, 0.0, 0.0]]), _held(low)
    seen, given = (none, low.v.now), (none, low.v.now)  # before and now: to neighbours, and what all are given
    loop, force = _forced(low, low.v.now)
    factors = first, slope
    for _ in range(low.model.stages - 1):
        new = tuple(low.program.temporary(low.vertices, 3) for _ in range(2))
        after = _stage(low, loop, seen, factors, held, force), _stage(low, loop, given, factors, low.number(0.0), force)
        for value, field in zip(after, new, strict=True):
            loop.put(value, field)
        seen, given, factors = (seen[1], new[0]), (given[1], new[1]), (2 * first, 2 * slope)
        loop, force = _forced(low, seen[1])
    both = loop.call("plus3", loop.load(low.v.now), _stage(low, loop, given, factors, low.number(0.0), force))
    return loop, loop.call("scaled3", loop.load(low.number(1 / (1 + PEAK))), both)


def _forced(low: Lowering, velocity: Field) -> tuple[Loop, Field]:
    """(a loop over the vertices, viscous forces at these velocities)."""
    force = low.program.temporary(low.vertices, 3)
    for add in low.viscous:
        add(velocity, force)
    return low.loop(low.vertices), force


def _stage(
    low: Lowering, loop: Loop, velocities: tuple[Field, Field], factors: tuple[float, float], held: Field, force: Field
) -> list[int]:
    """The next velocities after those (before, now)."""
    before, now = velocities
    fields = low.dt, *map(low.number, factors), held, now, before, force, low.mass
    inputs = [loop.load(field) for field in fields]
    if low.resistance is None:
        return loop.call("stage", *inputs)
    return loop.call("stage_in_air", *inputs, loop.load(low.resistance))


def _held(low: Lowering) -> Field:
    """How many boundaries hold each vertex in this substep."""
    grasps = {name: part for name, part in low.model.boundaries.items() if type(part) is Grasp and name in low.drives}
    if not grasps:
        return low.number(0.0)
    field = low.program.temporary(low.vertices, 1)
    for name, grasp in grasps.items():
        loop = low.program.loop(len(grasp.index), flat=True)
        loop.add(loop.load(low.drives[name].closed), field, low.program.table(grasp.index))
    return field
