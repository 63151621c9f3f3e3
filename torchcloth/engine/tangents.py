"""The engine's tangents: derivatives in many directions at once, carried beside the values."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from ..boundaries import Drive
from ..dynamics.forces import Impulses
from ..dynamics.model import Model
from ..types import ClothState
from . import conversion
from .fields import Field
from .fused import Fused
from .lowering import lower
from .operators import ops

Coefficients = dict[Field, Tensor]
Within = Callable[[Callable[[Model], Coefficients]], Coefficients]


class FusedTangents:
    """A model on the engine, with its derivatives along K directions.

    Args:
        fused: without parts in torch.
        within: gives the tangents [K, ...] of what a function makes of the model, where there are any.
        count: K.
    """

    def __init__(self, fused: Fused, within: Within, count: int) -> None:
        self.fused, self.within, self.count = fused, within, count
        self._known: dict[Field, Tensor] | None = None

    def rollout(
        self,
        state: ClothState,
        lost: Tensor | None,
        moved: ClothState,
        dt: float,
        drives: Mapping[str, Drive],
        driven: Mapping[str, Drive],
        substeps: int,
    ) -> tuple[ClothState, Tensor | None, ClothState, Impulses, Impulses]:
        """(state, what is lost, tangents of the state [K, ...], impulses, their tangents) after the substeps.

        ``driven``: drives' tangents; ``lost``: see ``functional.stretch``.
        """
        low, batch = self.fused.low, state.x.shape[:-2]
        program = low.program
        given = self.fused.job(state, torch.full((substeps,), dt, dtype=torch.float64), drives, lost).inputs
        dots = conversion.state_inputs(low, moved) | self._inputs(state, drives)
        if driven:
            dots |= {f: t for f, t in conversion.drive_inputs(low, driven).items() if f.comps > 1}  # not the flags
        behind = conversion.flat(low, {f: t.movedim(0, -3) for f, t in dots.items()}, batch, behind=3)
        fields = [f for f in program.inputs if f in behind]
        places = [program.inputs.index(f) for f in fields]
        inputs, tangents = [given[f] for f in program.inputs], [behind[f] for f in fields]
        results = ops.rollout_tangent(program.number, substeps, inputs, tangents, places)
        half = len(program.outputs)
        values = dict(zip(program.outputs, results[:half], strict=True))
        after, lost, impulses = conversion.outcome(low, state, values, batch)
        along = {f: t.movedim(1, 0) for f, t in zip(program.outputs, results[half:], strict=True)}
        shape = torch.Size((self.count, *batch))
        moved, _, shift = conversion.outcome(low, moved, {f: t.flatten(0, 1) for f, t in along.items()}, shape)
        return after, lost, moved, impulses, shift

    def _inputs(self, state: ClothState, drives: Mapping[str, Drive]) -> dict[Field, Tensor]:
        """Tangents [K, ..., rows, comps] of the coefficients that have any."""
        if self._known is None:
            own = self.fused

            def inputs(model: Model) -> Coefficients:
                low = lower(model._replace(stages=own.model.stages), state, drives)
                if low.program.fields != own.low.program.fields:
                    raise RuntimeError("along the directions, the parts make another program")
                return low.inputs

            self._known = self.within(inputs)
        return self._known
