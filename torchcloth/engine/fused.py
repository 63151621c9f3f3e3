"""The fused engine in the place of ``functional.rollout``."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint as recompute

from .._utils.torch_modes import transformed
from ..boundaries import Drive
from ..dynamics.contact.self_contact import CHUNK
from ..dynamics.forces import Impulses, added
from ..dynamics.model import Model
from ..types import ClothState, Trajectory
from . import conversion, devices, execution
from .execution import Job
from .fields import Field
from .operators import Rollout
from .torch_parts import TorchParts, divide


class Fused:
    """A model on the engine, for the length of one call of the cloth.

    Attributes:
        low: the program, with the numbers of the model.
        torch_parts: what torch computes in every substep; None: nothing, the engine runs by itself.

    Raises:
        Unfused: a part without kernels that torch cannot take over either.
    """

    def __init__(self, model: Model, state: ClothState, drives: Mapping[str, Drive]) -> None:
        self.model = model
        self._left = execution.BUDGET  # bytes of records that the adjoint may find ready
        self.low, parts = divide(model, state, drives)
        self.torch_parts = TorchParts(model, parts) if parts else None
        self._coefficients: dict[Field, Tensor] = {}

    def rollout(
        self,
        state: ClothState,
        dt: float,
        drives: Mapping[str, Drive],
        substeps: int,
        first: int = 0,
        checkpoint: bool = True,
    ) -> tuple[ClothState, Impulses]:
        """As ``functional.rollout``. ``checkpoint``: the adjoint keeps to a budget of memory, and recomputes beyond."""
        state, _, total = self.stretch(state, None, dt, drives, substeps, first, checkpoint)
        return state, total

    def stretch(
        self,
        state: ClothState,
        lost: Tensor | None,
        dt: float,
        drives: Mapping[str, Drive],
        substeps: int,
        first: int = 0,
        checkpoint: bool = True,
    ) -> tuple[ClothState, Tensor | None, Impulses]:
        """As ``functional.stretch``."""
        steps = torch.full((first + substeps,), dt, dtype=torch.float64)
        fixed, moves = self.coefficients(_batch(state)), self.moves(state, drives, steps)
        if self.torch_parts is None:
            return self._call(state, lost, fixed | _cut(moves, first, first + substeps), substeps, checkpoint)
        total: Impulses = {}
        again = checkpoint and recomputes()
        parts = self.torch_parts.as_they_are() if again else self.torch_parts
        last = first + substeps
        for begin in range(first, last, CHUNK):
            chunk = range(begin, min(begin + CHUNK, last))
            run = partial(self._shared, parts, dt, fixed, moves, chunk)
            state, lost, impulses = recompute(run, state, lost, use_reentrant=False) if again else run(state, lost)
            total = added(total, impulses)
        return state, lost, total

    def frames(
        self,
        state: ClothState,
        lost: Tensor | None,
        steps: Tensor,
        drives: Mapping[str, Drive],
        ends: tuple[int, ...],
    ) -> list[tuple[ClothState, Tensor | None, Impulses]]:
        """As ``stretch``, after so many substeps each, with the impulses since the one before.

        Of what ``is_plain``; ``steps``: [substeps] s.
        """
        results, _ = devices.forward(self.job(state, steps, drives, lost)._replace(ends=ends))
        found = []
        for row in zip(*(t.unbind(1) for t in results.values()), strict=True):
            found.append(conversion.outcome(self.low, state, dict(zip(results, row, strict=True)), _batch(state)))
        last, lost, impulses = found[-1]  # who keeps it keeps no other frames
        return [*found[:-1], (last.map(torch.clone), None if lost is None else lost.clone(), impulses)]

    @property
    def has_tangents(self) -> bool:
        """Whether ``FusedTangents`` is for it."""
        return self.torch_parts is None and not self.is_elsewhere

    @property
    def is_elsewhere(self) -> bool:
        """Whether its tensors are on a device."""
        return devices.elsewhere(self.model.mass)

    @property
    def rounding(self) -> Field | None:
        """The result that holds what was lost in float32, and has no digits of its own; None in float64."""
        return None if self.low.lost is None else self.low.lost.after

    def is_plain(self, state: ClothState, motion: Mapping[str, Trajectory]) -> bool:
        """The engine runs by itself on numbers from which nobody wants a derivative."""
        given = [state.x, state.v, state.d3, *state.memory.values(), *self.low.inputs.values()]
        moves = [part for m in motion.values() for part in (m.t, m.pose)]
        return self.torch_parts is None and _are_numbers([*given, *moves])

    def job(self, state: ClothState, steps: Tensor, drives: Mapping[str, Drive], lost: Tensor | None = None) -> Job:
        """What the engine is given, as plain numbers; without parts in torch."""
        batch, program = _batch(state), self.low.program
        found = self.coefficients(batch) | self.moves(state, drives, steps)
        found |= conversion.flat(self.low, conversion.state_inputs(self.low, state, lost), batch)
        return Job(program, {field: found[field] for field in program.inputs}, batch.numel(), len(steps))

    def coefficients(self, batch: torch.Size) -> dict[Field, Tensor]:
        """Inputs that stay the same over the substeps of a call."""
        if not self._coefficients:
            self._coefficients = conversion.flat(self.low, self.low.inputs, batch)
            if self.torch_parts is not None and recomputes():  # then parameters may have other values
                self._coefficients = {field: t.clone() for field, t in self._coefficients.items()}
        return self._coefficients

    def moves(self, state: ClothState, drives: Mapping[str, Drive], steps: Tensor) -> dict[Field, Tensor]:
        """Inputs with a row for every substep; ``steps``: [substeps] s."""
        found = {**conversion.drive_inputs(self.low, drives), self.low.dt: steps.unsqueeze(-1)}
        return conversion.flat(self.low, found, _batch(state))

    def _shared(
        self,
        parts: TorchParts,
        dt: float,
        fixed: dict[Field, Tensor],
        moves: dict[Field, Tensor],
        substeps: range,
        state: ClothState,
        lost: Tensor | None,
    ) -> tuple[ClothState, Tensor | None, Impulses]:
        """Substeps in which torch has a part."""
        total: Impulses = {}
        for k in substeps:
            force, memory = parts.force(state, lost, dt)
            state, lost, impulses = self._call(state, lost, fixed | _cut(moves, k, k + 1), 1, False, force)
            state = state._replace(memory=state.memory | memory)
            total = added(total, impulses)
        return state, lost, total

    def _call(
        self,
        state: ClothState,
        lost: Tensor | None,
        others: dict[Field, Tensor],
        substeps: int,
        checkpoint: bool,
        force: Tensor | None = None,
    ) -> tuple[ClothState, Tensor | None, Impulses]:
        low, program, batch = self.low, self.low.program, _batch(state)
        begin = conversion.state_inputs(low, state, lost)
        if low.torch_force is not None and force is not None:
            begin[low.torch_force] = force
        by_field = others | conversion.flat(low, begin, batch)
        inputs = [by_field[field] for field in program.inputs]
        if _are_numbers(inputs):
            job = Job(program, dict(zip(program.inputs, inputs, strict=True)), batch.numel(), substeps)
            return conversion.outcome(low, state, devices.forward(job)[0], batch)
        every = self._every(batch.numel(), substeps, checkpoint) if _needs_gradient(inputs) else 0
        *results, _ = Rollout.apply(program.number, substeps, every, *inputs)  # type: ignore[misc]
        return conversion.outcome(low, state, dict(zip(program.outputs, results, strict=True)), batch)

    def _every(self, scenes: int, substeps: int, checkpoint: bool) -> int:
        """Substeps between records: all while the budget lasts; 0: the adjoint makes its own when it comes here."""
        if self.is_elsewhere:
            return 0
        if not checkpoint:
            return 1
        size = execution.full_size(self.low.program, scenes, substeps)
        if size > self._left:
            return 0
        self._left -= size
        return 1


def rollout(model: Model, state: ClothState, dt: float, drives: Mapping[str, Drive], substeps: int):
    """As ``functional.rollout``, from substep 0 of the drives.

    Raises:
        Unfused: a part without kernels.
    """
    return Fused(model, state, drives).rollout(state, dt, drives, substeps)


def _batch(state: ClothState) -> torch.Size:
    return state.x.shape[:-2]


def _cut(moves: Mapping[Field, Tensor], first: int, last: int) -> dict[Field, Tensor]:
    """The rows of some substeps."""
    return {field: rows[:, first:last].contiguous() for field, rows in moves.items()}


def recomputes() -> bool:
    """Whether a backward pass may come that can compute again; ``torch.func`` knows of no tensors that are not kept."""
    return torch.is_grad_enabled() and not torch._C._are_functorch_transforms_active()


def _are_numbers(inputs: list[Tensor]) -> bool:
    """And nothing else: nobody needs to know of the operator, which costs as much as some tens of substeps."""
    return not transformed() and all(type(t) is Tensor for t in inputs) and not _needs_gradient(inputs)


def _needs_gradient(inputs: list[Tensor]) -> bool:
    return torch.is_grad_enabled() and any(t.requires_grad for t in inputs)
