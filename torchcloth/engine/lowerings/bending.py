"""Effects that bend the sheet."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

from torch import Tensor

from ...effects import Bending, BendingFriction, CreasingBending, SaturatingBending
from ...effects._plate import Plate
from ...effects.bending import Coefficients
from ...effects.saturating import Coefficients as SaturatingCoefficients
from ..builder import BendingLoop, SubstepBuilder, lowers
from ..enums import StencilForm
from ..fields import Field


@lowers(Bending)
def lower_bending(builder: SubstepBuilder, name: str, effect: Bending, c: Coefficients) -> None:
    """Add elastic and viscous bending by one matrix, and the moment of the rest curvature."""
    _add_plate_forces(builder, effect, c)
    if c.curl is not None:
        bending = builder.bending_loop(effect.stencil)
        _add_rest_moment(bending, builder, c, bending.loop.load(builder.parameter(c.curl)))


@lowers(CreasingBending)
def lower_creasing(builder: SubstepBuilder, name: str, effect: CreasingBending, c: Coefficients) -> None:
    """Add bending with a rest curvature that flows."""
    _add_plate_forces(builder, effect, c)
    bending, memory = builder.bending_loop(effect.stencil), builder.memory[f"effects.{name}"]
    curl, mobility = (builder.parameter(cast("Tensor", part)) for part in (c.curl, c.mobility))
    fields = (curl, memory.start, mobility, builder.dt, builder.number(effect.yield_curvature))
    result = bending.loop.call("crease", bending.curvature, *(bending.loop.load(field) for field in fields))
    bending.loop.store(result[:3], memory.end)
    _add_rest_moment(bending, builder, c, result[3:])


@lowers(BendingFriction)
def lower_bending_friction(builder: SubstepBuilder, name: str, effect: BendingFriction, c: Tensor) -> None:
    """Add the moment that opposes changes of curvature."""
    bending, memory = builder.bending_loop(effect.stencil), builder.memory[f"effects.{name}"]
    fields = (memory.start, builder.number(effect.threshold), builder.parameter(c))
    inputs = (bending.loop.load(field) for field in fields)
    result = bending.loop.call("bending_friction", bending.curvature, *inputs)
    bending.loop.store(result[:6], memory.end)
    bending.add_moment(result[6:])


@lowers(SaturatingBending)
def lower_saturating(builder: SubstepBuilder, name: str, effect: SaturatingBending, c: SaturatingCoefficients) -> None:
    """Add the stress of a saturating moment on the second derivatives alone."""
    bending = builder.bending_loop(effect.stencil)
    values = [bending.loop.load(builder.parameter(value)) for value in (c.moment, c.curvature)]
    bending.add_stress(bending.loop.call("saturating_bending", bending.second, *values))


def _add_plate_forces(builder: SubstepBuilder, effect: Bending, c: Coefficients) -> None:
    """Add -Q (stiffness x + viscosity v); weights that are parameters need to know what they weighed."""
    if c.operator is None:
        columns = effect.columns.cpu().numpy()
        weight = builder.program.constant(effect.operator.reshape(-1, 1), neighbours=len(columns))
    else:
        columns = effect.plate_operator.columns.cpu().numpy()
        weight = builder.parameter(c.operator, neighbours=len(columns))

    def add(kernel: str, inputs: Sequence[Field], force: Field) -> None:
        operand = builder.program.temporary(builder.vertices, 3, is_recorded=c.operator is not None)
        loop = builder.loop(builder.vertices)
        loop.store(loop.call(kernel, *(loop.load(field) for field in inputs)), operand)
        builder.program.stencil(columns, weight, operand, force, StencilForm.SYMMETRIC)

    stiffness, viscosity = builder.parameter(c.stiffness), builder.parameter(c.viscosity)
    if builder.model.stages and effect.damping_time is not None:
        add("scale3", [stiffness, builder.x.start], builder.force)
        builder.viscous_forces.append(lambda v, force: add("scale3", [viscosity, v], force))
    else:
        add("plate_operand", [stiffness, viscosity, builder.x.start, builder.v.start], builder.force)


def _add_rest_moment(bending: BendingLoop, builder: SubstepBuilder, c: Coefficients, rest: list[int]) -> None:
    plate = [bending.loop.load(builder.parameter(part)) for part in cast("Plate", c.plate)]
    bending.add_moment(bending.loop.call("rest_moment", *plate, rest))
