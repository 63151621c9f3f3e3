"""Viscous forces in stages."""

from __future__ import annotations

from ...boundaries import Grasp
from ...relaxation import PEAK, Polynomial
from ..fields import Field
from ..loops import Loop
from ..lowering import Lowering


def relaxed(low: Lowering) -> tuple[Loop, list[int]]:
    """A loop over the vertices, and in it their velocities after what the parts put into ``low.viscous``."""
    first, slope = Polynomial.of(low.model.stages)
    before, now, held = low.program.constant([[0.0, 0.0, 0.0]]), low.v.now, _held(low)
    for stage in range(low.model.stages):
        force = low.program.temporary(low.vertices, 3)
        for add in low.viscous:
            add(now, force)
        loop, often = low.loop(low.vertices), 2.0 if stage else 1.0
        factors = low.dt, low.number(often * first), low.number(often * slope), held
        inputs = [loop.load(field) for field in (*factors, now, before, force, low.mass)]
        if low.resistance is None:
            after = loop.call("stage", *inputs)
        else:
            after = loop.call("stage_in_air", *inputs, loop.load(low.resistance))
        if stage == low.model.stages - 1:
            both = loop.call("plus3", loop.load(low.v.now), after)
            return loop, loop.call("scaled3", loop.load(low.number(1 / (1 + PEAK))), both)
        before, now = now, low.program.temporary(low.vertices, 3)
        loop.put(after, now)
    raise ValueError("no stages")


def _held(low: Lowering) -> Field:
    """How many boundaries hold each vertex in this substep."""
    grasps = [
        (b, low.drives[name]) for name, b in low.model.boundaries.items() if type(b) is Grasp and name in low.drives
    ]
    if not grasps:
        return low.number(0.0)
    field = low.program.temporary(low.vertices, 1)
    for grasp, motion in grasps:
        loop = low.program.loop(len(grasp.index), flat=True)
        loop.add(loop.load(motion.closed), field, low.program.table(grasp.index))
    return field
