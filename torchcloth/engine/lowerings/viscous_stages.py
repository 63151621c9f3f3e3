"""Viscous forces in stages: ``dynamics/viscous_stages.py``."""

from __future__ import annotations

from ...boundaries import Grasp
from ...dynamics.viscous_stages import CHEBYSHEV_PEAK, StagePolynomial
from ..builder import SubstepBuilder
from ..fields import Field
from ..loops import Loop


def lower_viscous_stages(builder: SubstepBuilder) -> tuple[Loop, list[int]]:
    """Return a loop over the vertices, and registers of their velocities after all viscous stages."""
    if not builder.viscous_forces:
        loop = builder.loop(builder.vertices)
        return loop, loop.load(builder.v.start)
    first, slope = StagePolynomial.for_stages(builder.model.stages)
    zero, grip_count = builder.program.constant([[0.0, 0.0, 0.0]]), _grip_count(builder)
    # (before, now): velocities as neighbours see them, and velocities without the grips
    seen, free = (zero, builder.v.start), (zero, builder.v.start)
    loop, force = _viscous_force(builder, builder.v.start)
    factors = first, slope
    for _ in range(builder.model.stages - 1):
        new = tuple(builder.program.temporary(builder.vertices, 3) for _ in range(2))
        no_grips = builder.number(0.0)
        after = (
            _add_stage(builder, loop, seen, factors, grip_count, force),
            _add_stage(builder, loop, free, factors, no_grips, force),
        )
        for value, field in zip(after, new, strict=True):
            loop.store(value, field)
        seen, free, factors = (seen[1], new[0]), (free[1], new[1]), (2 * first, 2 * slope)
        loop, force = _viscous_force(builder, seen[1])
    last = _add_stage(builder, loop, free, factors, builder.number(0.0), force)
    total = loop.call("add3", loop.load(builder.v.start), last)
    return loop, loop.call("scale3", loop.load(builder.number(1 / (1 + CHEBYSHEV_PEAK))), total)


def _viscous_force(builder: SubstepBuilder, velocity: Field) -> tuple[Loop, Field]:
    """A new loop over the vertices, and the field of the viscous forces at these velocities."""
    force = builder.program.temporary(builder.vertices, 3)
    for add in builder.viscous_forces:
        add(velocity, force)
    return builder.loop(builder.vertices), force


def _add_stage(
    builder: SubstepBuilder,
    loop: Loop,
    velocities: tuple[Field, Field],
    factors: tuple[float, float],
    grip_count: Field,
    force: Field,
) -> list[int]:
    """Registers of the next velocities after those (before, now)."""
    before, now = velocities
    fields = builder.dt, *map(builder.number, factors), grip_count, now, before, force, builder.mass
    inputs = [loop.load(field) for field in fields]
    if builder.added_mass is None:
        return loop.call("viscous_stage", *inputs)
    return loop.call("viscous_stage_added_mass", *inputs, loop.load(builder.added_mass))


def _grip_count(builder: SubstepBuilder) -> Field:
    """How many grippers hold each vertex in this substep."""
    boundaries = builder.model.boundaries.items()
    grasps = {name: part for name, part in boundaries if type(part) is Grasp and name in builder.prescribed}
    if not grasps:
        return builder.number(0.0)
    field = builder.program.temporary(builder.vertices, 1)
    for name, grasp in grasps.items():
        loop = builder.program.loop(len(grasp.index), no_derivative=True)
        loop.add(loop.load(builder.prescribed[name].closed), field, builder.program.table(grasp.index))
    return field
