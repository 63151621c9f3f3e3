"""Effects that bend the sheet."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

from torch import Tensor

from ...effects import Bending, BendingFriction, CreasingBending, SaturatingBending
from ...effects._plate import Plate
from ...effects.bending import Coefficients
from ...effects.saturating import Coefficients as Saturating
from ..fields import Field
from ..lowering import Lowering
from ..shared_loops import Sheet
from ..stages import Shape


def plate(low: Lowering, name: str, effect: Bending, c: Coefficients) -> None:
    """Elastic and viscous, by one matrix; and what rest curvature adds."""
    _matrix(low, effect, c)
    if c.curl is not None:
        sheet = low.sheet(effect.sheet)
        _rest_moment(sheet, low, c, sheet.loop.load(low.parameter(c.curl)))


def creasing(low: Lowering, name: str, effect: CreasingBending, c: Coefficients) -> None:
    """The same with a rest curvature that flows."""
    _matrix(low, effect, c)
    sheet, memory = low.sheet(effect.sheet), low.memory[f"effects.{name}"]
    curl, mobility = (low.parameter(cast("Tensor", part)) for part in (c.curl, c.mobility))
    fields = (curl, memory.now, mobility, low.dt, low.number(effect.yield_curvature))
    after = sheet.loop.call("crease", sheet.curvature, *(sheet.loop.load(field) for field in fields))
    sheet.loop.put(after[:3], memory.after)
    _rest_moment(sheet, low, c, after[3:])


def friction(low: Lowering, name: str, effect: BendingFriction, c: Tensor) -> None:
    """Moment that opposes changes of curvature."""
    sheet, memory = low.sheet(effect.sheet), low.memory[f"effects.{name}"]
    fields = (memory.now, low.number(effect.threshold), low.parameter(c))
    after = sheet.loop.call("bending_friction", sheet.curvature, *(sheet.loop.load(field) for field in fields))
    sheet.loop.put(after[:6], memory.after)
    sheet.moment(after[6:])


def saturating(low: Lowering, name: str, effect: SaturatingBending, c: Saturating) -> None:
    """On the second derivatives alone."""
    sheet = low.sheet(effect.sheet)
    values = [sheet.loop.load(low.parameter(value)) for value in (c.moment, c.curvature)]
    sheet.stress(sheet.loop.call("saturating", sheet.second, *values))


def _matrix(low: Lowering, effect: Bending, c: Coefficients) -> None:
    """-Q (stiffness x + viscosity v); weights that are parameters need to know what they weighed."""
    if c.operator is None:
        columns = effect.columns.cpu().numpy()
        weight = low.program.constant(effect.operator.reshape(-1, 1), near=len(columns))
    else:
        columns = effect.woven.columns.cpu().numpy()
        weight = low.parameter(c.operator, near=len(columns))

    def straighten(kernel: str, inputs: Sequence[Field], force: Field) -> None:
        bent = low.program.temporary(low.vertices, 3, kept=c.operator is not None)
        loop = low.loop(low.vertices)
        loop.put(loop.call(kernel, *(loop.load(field) for field in inputs)), bent)
        low.program.stencil(columns, weight, bent, force, Shape.SYMMETRIC)

    stiffness, viscosity = low.parameter(c.stiffness), low.parameter(c.viscosity)
    if low.model.stages and effect.damping_time is not None:
        straighten("scaled3", [stiffness, low.x.now], low.force)
        low.viscous.append(lambda v, force: straighten("scaled3", [viscosity, v], force))
    else:
        straighten("bent", [stiffness, viscosity, low.x.now, low.v.now], low.force)


def _rest_moment(sheet: Sheet, low: Lowering, c: Coefficients, rest: list[int]) -> None:
    plate = [sheet.loop.load(low.parameter(part)) for part in cast("Plate", c.plate)]
    sheet.moment(sheet.loop.call("rest_moment", *plate, rest))
