"""The engine's tangents: derivatives along many directions at once, computed together with the values."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from ..boundaries import PrescribedMotion
from ..dynamics.forces import Impulses
from ..dynamics.model import Model
from ..types import ClothState
from . import conversion
from .fields import Field
from .fused import FusedEngine
from .lowering import lower
from .operators import ops

Coefficients = dict[Field, Tensor]
TangentsOf = Callable[[Callable[[Model], Coefficients]], Coefficients]


class FusedTangents:
    """A model on the engine, with its derivatives along K directions.

    Args:
        fused: the engine, without parts in torch.
        tangents_of: returns the tangents [K, ...] of what a function makes of the model, where there are any.
        count: K.
    """

    def __init__(self, fused: FusedEngine, tangents_of: TangentsOf, count: int) -> None:
        self.fused, self.tangents_of, self.count = fused, tangents_of, count
        self._coefficient_tangents: dict[Field, Tensor] | None = None

    def rollout(
        self,
        state: ClothState,
        compensation: Tensor | None,
        state_tangent: ClothState,
        dt: float,
        prescribed: Mapping[str, PrescribedMotion],
        prescribed_tangents: Mapping[str, PrescribedMotion],
        substeps: int,
        first_substep: int = 0,
    ) -> tuple[ClothState, Tensor | None, ClothState, Impulses, Impulses]:
        """Run substeps with tangents.

        Args:
            state: at the start.
            compensation: rounding error of the positions, as for ``dynamics.substep.rollout_segment``.
            state_tangent: [K, ...] of the state.
            dt: substep [s].
            prescribed: motions by boundary.
            prescribed_tangents: their tangents, by boundary.
            substeps: how many.
            first_substep: as in ``Grid``.

        Returns:
            State, compensation, tangents of the state [K, ...], impulses and their tangents after the substeps.
        """
        builder, batch = self.fused.builder, state.x.shape[:-2]
        program = builder.program
        steps = torch.full((substeps,), dt, dtype=torch.float64)
        inputs = self.fused.job(state, steps, prescribed, compensation, first_substep).inputs
        tangents = conversion.state_inputs(builder, state_tangent) | self._coefficients(state, prescribed)
        if prescribed_tangents:
            motions = conversion.prescribed_inputs(builder, prescribed_tangents)
            tangents |= {f: t for f, t in motions.items() if f.comps > 1}  # not of the flags
        leading = {f: t.movedim(0, -3) for f, t in tangents.items()}
        flat = conversion.flatten_batch(builder, leading, batch, trailing=3)
        fields = [f for f in program.inputs if f in flat]
        places = [program.inputs.index(f) for f in fields]
        values, moved = [inputs[f] for f in program.inputs], [flat[f] for f in fields]
        results = ops.rollout_tangent(program.number, substeps, values, moved, places)
        half = len(program.outputs)
        outputs = dict(zip(program.outputs, results[:half], strict=True))
        after, compensation, impulses = conversion.unflatten_results(builder, state, outputs, batch)
        along = {f: t.movedim(1, 0).flatten(0, 1) for f, t in zip(program.outputs, results[half:], strict=True)}
        shape = torch.Size((self.count, *batch))
        state_tangent, _, impulse_tangents = conversion.unflatten_results(builder, state_tangent, along, shape)
        return after, compensation, state_tangent, impulses, impulse_tangents

    def _coefficients(self, state: ClothState, prescribed: Mapping[str, PrescribedMotion]) -> dict[Field, Tensor]:
        """Tangents [K, ..., rows, comps] of the coefficients that have any."""
        if self._coefficient_tangents is None:
            engine = self.fused

            def inputs(model: Model) -> Coefficients:
                builder = lower(model._replace(stages=engine.model.stages), state, prescribed)
                if builder.program.fields != engine.builder.program.fields:
                    raise RuntimeError("along the directions, the parts make another program")
                return builder.inputs

            self._coefficient_tangents = self.tangents_of(inputs)
        return self._coefficient_tangents
