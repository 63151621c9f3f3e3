"""Effects on the cloth."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from ...effects import (
    AbstractEffect,
    AddedMass,
    Adhesion,
    AirDrag,
    Bending,
    BendingFriction,
    BodyForce,
    CreasingBending,
    Gravity,
    GripSlip,
    KelvinVoigt,
    LineMass,
    MassDamping,
    ResidualForce,
    RestShape,
    SaturatingBending,
    ShearFriction,
)
from ...effects.residual import Coefficients as Residual
from ..fields import Field
from ..lowering import Lowering, Unfused
from ..shared_loops import Triangles
from . import bending


def lower(low: Lowering, name: str, effect: AbstractEffect, c: Any) -> None:
    """Add an effect to the program."""
    part = _EFFECTS.get(type(effect))
    if part is None:
        raise Unfused(f"effect {name!r} ({type(effect).__name__})")
    part(low, name, effect, c)


def _weight(low: Lowering, name: str, effect: AbstractEffect, c: Any) -> None:
    low.pull("weight", low.mass, low.parameter(c))


def _mass_damping(low: Lowering, name: str, effect: MassDamping, c: Any) -> None:
    low.pull("mass_damping", low.parameter(c), low.mass, low.v.now)


def _adhesion(low: Lowering, name: str, effect: Adhesion, c: Any) -> None:
    plane = low.program.constant(torch.cat([effect.point, effect.normal, effect.point.new_tensor([effect.gap])])[None])
    low.pull("adhesion", low.x.now, low.parameter(c), low.program.constant(effect.area), plane)


def _air_drag(low: Lowering, name: str, effect: AirDrag, c: Any) -> None:
    t = low.triangles
    coefficients = [t.parameter(value) for value in (c.pressure, c.friction, c.wind)]
    t.push("air_drag", *t.x, *t.v, *coefficients)


def _added_mass(low: Lowering, name: str, effect: AddedMass, c: Any) -> None:
    if low.resistance is None:
        low.resistance = low.program.temporary(low.vertices, 6)
    t = low.triangles
    air = t.parameter(c)
    inertia = t.loop.call("added_mass", air, t.normal, t.area)
    for corner in low.corners:
        t.loop.add(inertia, low.resistance, corner)
    t.push("turning_air", t.surface[6:], *t.v, t.shape, t.area, air)


def _kelvin_voigt(low: Lowering, name: str, effect: KelvinVoigt, c: Any) -> None:
    _strain_rate(low, c)


def _strain_rate(low: Lowering, viscosity: Tensor) -> None:
    def resist(t: Triangles, columns: list[int]) -> None:
        t.stress(t.loop.call("kelvin_voigt", columns, *t.v, t.shape, t.parameter(viscosity)))

    columns = low.triangles.surface[:6]
    if not low.model.stages:
        return resist(low.triangles, columns)
    strained = low.program.temporary(low.faces, 6)
    low.triangles.loop.put(columns, strained)

    def later(v: Field, force: Field) -> None:
        triangles = Triangles(low, v, force)
        resist(triangles, triangles.loop.load(strained))
        triangles.close()

    low.viscous.append(later)


def _shear_friction(low: Lowering, name: str, effect: ShearFriction, c: Any) -> None:
    t, memory = low.triangles, low.memory[f"effects.{name}"]
    threshold = t.loop.load(low.number(effect.threshold))
    after = t.loop.call("shear_friction", t.surface, t.loop.load(memory.now), threshold, t.parameter(c))
    t.loop.put(after[:2], memory.after)
    t.stress(after[2:])


def _residual(low: Lowering, name: str, effect: ResidualForce, c: Residual) -> None:
    t = low.triangles
    if c.has_drag:
        none = t.loop.load(low.number(0.0))
        laws = [none if part is None else t.parameter(part) for part in c[:4]]
        t.push("local_drag", *t.x, *t.v, *laws, t.area)
    if c.strain_rate is not None:
        _strain_rate(low, c.strain_rate)
    if c.bend is not None:
        sheet = low.sheet(effect.stencil)
        sheet.moment(sheet.loop.call("scaled3", sheet.loop.load(low.parameter(c.bend)), sheet.curvature))


def _nothing(low: Lowering, name: str, effect: AbstractEffect, c: Any) -> None:
    """It acts through the vertices' mass, the material's rest shape, or in a grasp, alone."""


_EFFECTS: dict[type, Callable[[Lowering, str, Any, Any], None]] = {
    AddedMass: _added_mass,
    Adhesion: _adhesion,
    AirDrag: _air_drag,
    Bending: bending.plate,
    BendingFriction: bending.friction,
    BodyForce: _weight,
    CreasingBending: bending.creasing,
    Gravity: _weight,
    GripSlip: _nothing,
    KelvinVoigt: _kelvin_voigt,
    LineMass: _nothing,
    MassDamping: _mass_damping,
    ResidualForce: _residual,
    RestShape: _nothing,
    SaturatingBending: bending.saturating,
    ShearFriction: _shear_friction,
}
