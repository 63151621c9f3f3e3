"""Effects on vertices and triangles."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ...effects import (
    AbstractEffect,
    AddedMass,
    Adhesion,
    AirDrag,
    BodyForce,
    Gravity,
    GripSlip,
    KelvinVoigt,
    LineMass,
    MassDamping,
    ResidualForce,
    RestShape,
    ShearFriction,
)
from ...effects.residual import Coefficients as ResidualCoefficients
from ..builder import SubstepBuilder, TriangleLoop, lowers
from ..fields import Field


@lowers(BodyForce, Gravity)
def lower_weight(builder: SubstepBuilder, name: str, effect: AbstractEffect, c: Any) -> None:
    """Add mass times acceleration."""
    builder.add_vertex_force("weight", builder.mass, builder.parameter(c))


@lowers(MassDamping)
def lower_mass_damping(builder: SubstepBuilder, name: str, effect: MassDamping, c: Any) -> None:
    """Add a drag in proportion to mass and velocity."""
    builder.add_vertex_force("mass_damping", builder.parameter(c), builder.mass, builder.v.start)


@lowers(Adhesion)
def lower_adhesion(builder: SubstepBuilder, name: str, effect: Adhesion, c: Any) -> None:
    """Add the attraction of a plane."""
    plane = torch.cat([effect.point, effect.normal, effect.point.new_tensor([effect.gap])])[None]
    constant = builder.program.constant
    builder.add_vertex_force("adhesion", builder.x.start, builder.parameter(c), constant(effect.area), constant(plane))


@lowers(AirDrag)
def lower_air_drag(builder: SubstepBuilder, name: str, effect: AirDrag, c: Any) -> None:
    """Add the drag of air on the triangles."""
    t = builder.triangles
    coefficients = [t.parameter(value) for value in (c.half_density_cn, c.half_density_ct, c.wind)]
    t.add_corner_forces("air_drag", *t.x, *t.v, *coefficients)


@lowers(AddedMass)
def lower_added_mass(builder: SubstepBuilder, name: str, effect: AddedMass, c: Any) -> None:
    """Add the mass of the air that moves along, and its force as the normals turn."""
    if builder.added_mass is None:
        builder.added_mass = builder.program.temporary(builder.vertices, 6)
    t = builder.triangles
    density = t.parameter(c)
    inertia = t.loop.call("added_mass", density, t.normal, t.area)
    for corner in builder.corners:
        t.loop.add(inertia, builder.added_mass, corner)
    t.add_corner_forces("added_mass_turning", t.surface[6:], *t.v, t.shape, t.area, density)


@lowers(KelvinVoigt)
def lower_kelvin_voigt(builder: SubstepBuilder, name: str, effect: KelvinVoigt, c: Any) -> None:
    """Add the viscous stress of the strain rate."""
    _add_viscous_stress(builder, c)


@lowers(ShearFriction)
def lower_shear_friction(builder: SubstepBuilder, name: str, effect: ShearFriction, c: Any) -> None:
    """Add the stress of friction between the yarns."""
    t, memory = builder.triangles, builder.memory[f"effects.{name}"]
    threshold = t.loop.load(builder.number(effect.threshold))
    result = t.loop.call("shear_friction", t.surface, t.loop.load(memory.start), threshold, t.parameter(c))
    t.loop.store(result[:2], memory.end)
    t.add_stress(result[2:])


@lowers(ResidualForce)
def lower_residual_force(builder: SubstepBuilder, name: str, effect: ResidualForce, c: ResidualCoefficients) -> None:
    """Add local drag, viscous stress and bending moment, each where it has a coefficient."""
    t = builder.triangles
    if c.has_drag:
        zero = t.loop.load(builder.number(0.0))
        coefficients = [zero if part is None else t.parameter(part) for part in c[:4]]
        t.add_corner_forces("local_drag", *t.x, *t.v, *coefficients, t.area)
    if c.strain_rate is not None:
        _add_viscous_stress(builder, c.strain_rate)
    if c.bend is not None:
        bending = builder.bending_loop(effect.stencil)
        stiffness = bending.loop.load(builder.parameter(c.bend))
        bending.add_moment(bending.loop.call("scale3", stiffness, bending.curvature))


@lowers(GripSlip, LineMass, RestShape)
def lower_without_force(builder: SubstepBuilder, name: str, effect: AbstractEffect, c: Any) -> None:
    """Add nothing: the effect acts in a grasp, through the vertices' mass or through the rest shape alone."""


def _add_viscous_stress(builder: SubstepBuilder, viscosity: Tensor) -> None:
    def add(t: TriangleLoop, columns: list[int]) -> None:
        t.add_stress(t.loop.call("kelvin_voigt", columns, *t.v, t.shape, t.parameter(viscosity)))

    columns = builder.triangles.surface[:6]
    if not builder.model.stages:
        add(builder.triangles, columns)
        return
    deformation = builder.program.temporary(builder.faces, 6)
    builder.triangles.loop.store(columns, deformation)

    def add_in_stage(v: Field, force: Field) -> None:
        triangles = TriangleLoop(builder, v, force)
        add(triangles, triangles.loop.load(deformation))
        triangles.close()

    builder.viscous_forces.append(add_in_stage)
