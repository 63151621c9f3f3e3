"""Effects on the cloth."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ...effects import AbstractEffect, AddedMass, AirDrag, Bending, Gravity, LineMass, MassDamping
from ..lowering import Lowering, Unfused
from ..program import Shape


def lower(low: Lowering, name: str, effect: AbstractEffect, c: Any) -> None:
    """Add an effect to the program."""
    part = _EFFECTS.get(type(effect))
    if part is None:
        raise Unfused(f"effect {name!r} ({type(effect).__name__})")
    part(low, name, effect, c)


def _gravity(low: Lowering, name: str, effect: Gravity, c: Any) -> None:
    loop = low.loop(low.vertices)
    loop.add(loop.call("weight", loop.load(low.mass), loop.load(low.parameter(c))), low.force)


def _mass_damping(low: Lowering, name: str, effect: MassDamping, c: Any) -> None:
    loop = low.loop(low.vertices)
    rate, mass, v = (loop.load(field) for field in (low.parameter(c), low.mass, low.v.now))
    loop.add(loop.call("mass_damping", rate, mass, v), low.force)


def _air_drag(low: Lowering, name: str, effect: AirDrag, c: Any) -> None:
    t = low.triangles
    coefficients = [t.parameter(value) for value in (c.pressure, c.friction, c.wind)]
    t.push(t.loop.call("air_drag", t.velocity, t.normal, t.J, t.area, *coefficients))


def _added_mass(low: Lowering, name: str, effect: AddedMass, c: Any) -> None:
    if low.resistance is None:
        low.resistance = low.program.temporary(low.vertices, 6)
    t = low.triangles
    air = t.loop.call("added_mass", t.parameter(c), t.normal, t.J, t.area)
    for corner in low.corners:
        t.loop.add(air, low.resistance, corner)


def _bending(low: Lowering, name: str, effect: Bending, c: Any) -> None:
    if c.operator is not None or c.curl is not None:
        raise Unfused(f"effect {name!r} (Bending with fields, ratios or curl)")
    bent = low.program.temporary(low.vertices, 3, kept=False)  # the operator is constant: no need to know on what
    loop = low.loop(low.vertices)
    parts = [low.parameter(c.stiffness), low.parameter(c.viscosity), low.x.now, low.v.now]
    loop.put(loop.call("bent", *(loop.load(field) for field in parts)), bent)
    weight = low.program.constant(effect.operator.reshape(-1, 1), near=len(effect.columns))
    low.program.stencil(effect.columns.cpu().numpy(), weight, bent, low.force, Shape.SYMMETRIC)


def _nothing(low: Lowering, name: str, effect: AbstractEffect, c: Any) -> None:
    """It acts through the vertices' mass alone."""


_EFFECTS: dict[type, Callable[[Lowering, str, Any, Any], None]] = {
    AddedMass: _added_mass,
    AirDrag: _air_drag,
    Bending: _bending,
    Gravity: _gravity,
    LineMass: _nothing,
    MassDamping: _mass_damping,
}
