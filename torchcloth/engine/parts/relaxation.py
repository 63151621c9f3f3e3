"""Viscous forces in stages."""

from __future__ import annotations

from ...boundaries import Grasp
from ...relaxation import PEAK, Polynomial
from ..fields import Field
from ..loops import Loop
from ..lowering import Lowering


def relaxed(low: Lowering) -> tuple[Loop, list[int]]:
    """A loop over the vertices, and in it their velocities after what the parts put into ``low.viscous``."""
    if not low.viscous:
        loop = low.loop(low.vertices)
        return loop, loop.load(low.v.now)
    first, slope = Polynomial.of(low.model.stages)
    before, now, held = low.program.constant([[0.0, 0.0, 0.0]]), low.v.now, _held(low)
    loop, after = _stage(low, before, now, (first, slope), held)
    for _ in range(low.model.stages - 1):
        before, now = now, low.program.temporary(low.vertices, 3)
        loop.put(after, now)
        loop, after = _stage(low, before, now, (2 * first, 2 * slope), held)
    both = loop.call("plus3", loop.load(low.v.now), after)
    return loop, loop.call("scaled3", loop.load(low.number(1 / (1 + PEAK))), both)


def _stage(
    low: Lowering, before: Field, now: Field, factors: tuple[float, float], held: Field
) -> tuple[Loop, list[int]]:
    force = low.program.temporary(low.vertices, 3)
    for add in low.viscous:
        add(now, force)
    loop = low.loop(low.vertices)
    fields = low.dt, *map(low.number, factors), held, now, before, force, low.mass
    inputs = [loop.load(field) for field in fields]
    if low.resistance is None:
        return loop, loop.call("stage", *inputs)
    return loop, loop.call("stage_in_air", *inputs, loop.load(low.resistance))


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
