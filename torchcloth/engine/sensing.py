"""The engine's tangents: derivatives in many directions at once, carried beside the values."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor

from ..boundaries import Drive
from ..dynamics import Impulses
from ..model import Model
from ..types import ClothState
from . import binding
from .fused import Fused, cut, spans
from .lowering import Lowering, lower
from .operators import ops
from .program import Field

Coefficients = dict[Field, Tensor | None]
Within = Callable[[int, Callable[[Model], Coefficients]], Coefficients]  # work on the model that is dual along k


class Sensing:
    """A model on the engine, with its derivatives along K directions.

    Args:
        fused: without parts outside.
        within: calls a function with the model that is dual along direction k, in a level of forward mode.
        count: K.
    """

    def __init__(self, fused: Fused, within: Within, count: int) -> None:
        self.fused, self.within, self.count = fused, within, count
        self._known: dict[int, dict[Field, Tensor]] = {}

    def rollout(
        self,
        state: ClothState,
        moved: ClothState,
        dt: float,
        drives: Mapping[str, Drive],
        driven: Mapping[str, Drive],
        substeps: int,
    ) -> tuple[ClothState, ClothState, Impulses, Impulses]:
        """(state, its tangents [K, ...], impulses, their tangents) after the substeps; ``driven``: drives' tangents."""
        total: Impulses = {}
        shifts: Impulses = {}
        for begin, end in spans(drives, 0, substeps, substeps):
            pieces = cut(drives, begin, end), cut(driven, begin, end)
            state, moved, impulses, shift = self._span(state, moved, dt, *pieces, end - begin)
            total = {name: total[name] + j if name in total else j for name, j in impulses.items()}
            shifts = {name: shifts[name] + j if name in shifts else j for name, j in shift.items()}
        return state, moved, total, shifts

    def _span(self, state, moved, dt, drives, driven, substeps):
        low = self.fused.lowering(state, drives)
        program, batch = low.program, state.x.shape[:-2]
        values = binding.flat(low, binding.states(low, state) | binding.moves(low, drives), batch)
        values |= self.fused.coefficients(low, dt, batch)
        dots = {**binding.states(low, moved), **self._inputs(low, state, drives)}
        if driven:
            dots |= binding.moves(low, driven)
        behind = binding.flat(low, {f: t.movedim(0, -3) for f, t in dots.items()}, batch, behind=3)
        fields = [f for f in program.inputs if f in behind]
        places = [program.inputs.index(f) for f in fields]
        inputs, tangents = [values[f] for f in program.inputs], [behind[f] for f in fields]
        results = ops.rollout_tangent(program.number, substeps, inputs, tangents, places)
        half = len(program.outputs)
        after, impulses = binding.outcome(low, state, dict(zip(program.outputs, results[:half], strict=True)), batch)
        along = {f: t.movedim(1, 0) for f, t in zip(program.outputs, results[half:], strict=True)}
        shape = torch.Size((self.count, *batch))
        moved, shift = binding.outcome(low, moved, {f: t.flatten(0, 1) for f, t in along.items()}, shape)
        return after, moved, impulses, shift

    def _inputs(self, low: Lowering, state: ClothState, drives: Mapping[str, Drive]) -> dict[Field, Tensor]:
        """Tangents [K, ..., rows, comps] of the coefficients that have any."""
        number = low.program.number
        if number not in self._known:

            def found_in(model: Model) -> Coefficients:
                found = lower(model, state, cut(drives, 0, 1)).inputs
                return {f: forward_ad.unpack_dual(t).tangent for f, t in found.items()}

            every = [self.within(k, found_in) for k in range(self.count)]
            moved = [f for f in low.inputs if any(found[f] is not None for found in every)]
            full = {f: [_or_zero(found[f], low.inputs[f]) for found in every] for f in moved}
            self._known[number] = {f: torch.stack(tangents) for f, tangents in full.items()}
        return self._known[number]


def _or_zero(tangent: Tensor | None, like: Tensor) -> Tensor:
    return torch.zeros_like(like) if tangent is None else tangent.detach()
