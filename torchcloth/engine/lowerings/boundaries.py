"""Boundaries: each takes the velocities before it and leaves velocities that obey it."""

from __future__ import annotations

from typing import Any

from ...boundaries import AbstractCollider, Grasp
from ...effects import GripSlip
from ..builder import SubstepBuilder, UnsupportedPart, VelocityStage, lowering_of
from ..fields import Field
from ..loops import Loop
from . import sample_points
from .body import BodyLowering


def lower_boundaries(builder: SubstepBuilder, velocity: VelocityStage) -> None:
    """Add all boundaries in order, and the impulses of the prescribed ones; ``dynamics/forces.py``, ``constrain``.

    Raises:
        UnsupportedPart: a boundary has no kernels.
    """
    boundaries = list(builder.model.boundaries.items())
    for k, (name, boundary) in enumerate(boundaries):
        if type(boundary) is Grasp:
            field = velocity.to_field(drift=all(type(other) is Grasp for _, other in boundaries[k:]))
            if name in builder.prescribed:
                _add_grasp(builder, name, boundary, velocity, field)
            continue
        if not isinstance(boundary, AbstractCollider) or lowering_of(boundary) is None:
            raise UnsupportedPart(f"boundary {name!r} ({type(boundary).__name__})")
        velocity.to_registers()
        velocity.velocities_before = velocity.velocities
        _add_collider(builder, name, boundary, velocity)
        if name in builder.prescribed:
            _add_impulse(builder, name, velocity.loop, None, velocity.velocities_before, velocity.velocities)


def _add_grasp(builder: SubstepBuilder, name: str, grasp: Grasp, velocity: VelocityStage, field: Field) -> None:
    """Overwrite the rows of the grasped vertices alone; their earlier values are recorded for the reverse sweep."""
    rows, count = builder.program.table(grasp.index), len(grasp.index)
    increment, _, closed = builder.prescribed[name]
    free = builder.program.temporary(count, 3)
    loop = builder.loop(count)
    loop.store(loop.load(field, rows), free)
    loop = builder.loop(count)
    inputs = [loop.load(f) for f in (increment, builder.dt, closed)]
    grasped = loop.call("grasp_velocity", *inputs, loop.load(builder.x.start, rows), loop.load(free))
    for key, (effect, c) in builder.model.effects.items():
        if effect.grasp != name:
            continue
        if type(effect) is not GripSlip:
            raise UnsupportedPart(f"effect {key!r} ({type(effect).__name__})")
        loop, grasped = _add_grip_slip(builder, rows, loop, free, grasped, c)
    _add_impulse(builder, name, loop, rows, loop.load(free), grasped)
    velocity.scatter_rows(loop, rows, grasped)


def _add_collider(builder: SubstepBuilder, name: str, solid: AbstractCollider, velocity: VelocityStage) -> None:
    body = BodyLowering(builder, name, solid)
    if solid.points is not None:
        sample_points.add_point_contact(builder, solid.points, body, velocity)
    loop = velocity.loop
    x, ratio = loop.load(builder.x.start), builder.added_mass_ratio(loop)
    velocity.velocities = loop.call(
        "add3", velocity.velocities, body.velocity_change(loop, x, velocity.velocities, ratio)
    )


def _add_grip_slip(
    builder: SubstepBuilder, rows: int, loop: Loop, free: Field, grasped: list[int], c: Any
) -> tuple[Loop, list[int]]:
    """Add the slip; returns a new loop over the grasped vertices, and registers of their velocities in it."""
    masses = [builder.mass] if builder.added_mass is None else [builder.mass, builder.added_mass]
    pull, *patch_masses = (builder.program.temporary(1, comps) for comps in (3, *(m.comps for m in masses)))
    grasp_velocity = builder.program.temporary(free.rows, 3)
    loop.add(builder.momentum(loop, loop.call("subtract3", grasped, loop.load(free)), rows), pull)
    for mass, patch_mass in zip(masses, patch_masses, strict=True):
        loop.add(loop.load(mass, rows), patch_mass)
    loop.store(grasped, grasp_velocity)
    loop = builder.loop(free.rows)
    fields = (pull, *patch_masses, builder.parameter(c.mobility), builder.parameter(c.hold), builder.dt)
    law = "grip_creep" if builder.added_mass is None else "grip_creep_added_mass"
    return loop, loop.call(law, loop.load(grasp_velocity), *(loop.load(field) for field in fields))


def _add_impulse(
    builder: SubstepBuilder, name: str, loop: Loop, rows: int | None, before: list[int], after: list[int]
) -> None:
    """Add the impulse and its moment about the body's origin."""
    increment, pose, _ = builder.prescribed[name]
    momentum = builder.momentum(loop, loop.call("subtract3", after, before), rows)
    place = loop.load(builder.x.start, rows), loop.load(increment), loop.load(pose)
    loop.add(loop.call("impulse", momentum, *place), builder.impulses[name])
