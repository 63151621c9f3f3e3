"""The fused engine in the place of ``dynamics.substep.rollout``."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import torch
from torch import Tensor
from torch.utils import checkpoint as torch_checkpoint

from .._utils.torch_modes import under_torch_transform
from ..boundaries import PrescribedMotion
from ..dynamics.contact import grid_shifts
from ..dynamics.contact.self_contact import SUBSTEPS_PER_CHECKPOINT
from ..dynamics.forces import Impulses, add_impulses
from ..dynamics.model import Model
from ..types import ClothState, Trajectory
from . import conversion, devices, execution
from .execution import Job
from .fields import Field
from .operators import Rollout
from .torch_parts import TorchParts, divide


class FusedEngine:
    """A model on the engine, for the length of one call of the cloth.

    Attributes:
        model: the model.
        builder: the program, with the numbers of the model.
        torch_parts: what torch computes in every substep; None: the engine runs by itself.

    Raises:
        UnsupportedPart: a part has no kernels, and torch cannot take it over either.
    """

    def __init__(self, model: Model, state: ClothState, prescribed: Mapping[str, PrescribedMotion]) -> None:
        self.model = model
        self._record_bytes_left = execution.RECORD_BUDGET_BYTES
        self.builder, parts = divide(model, state, prescribed)
        self.torch_parts = TorchParts(model, parts) if parts else None
        self._coefficients: dict[Field, Tensor] = {}

    def rollout(
        self,
        state: ClothState,
        dt: float,
        prescribed: Mapping[str, PrescribedMotion],
        substeps: int,
        first: int = 0,
        checkpoint: bool = True,
    ) -> tuple[ClothState, Impulses]:
        """Run substeps as ``dynamics.substep.rollout`` does.

        ``checkpoint``: the adjoint keeps to a budget of memory, and recomputes what exceeds it.
        """
        state, _, total = self.rollout_segment(state, None, dt, prescribed, substeps, first, checkpoint)
        return state, total

    def rollout_segment(
        self,
        state: ClothState,
        compensation: Tensor | None,
        dt: float,
        prescribed: Mapping[str, PrescribedMotion],
        substeps: int,
        first: int = 0,
        checkpoint: bool = True,
        first_substep: int = 0,
    ) -> tuple[ClothState, Tensor | None, Impulses]:
        """Run substeps as ``dynamics.substep.rollout_segment`` does; ``checkpoint`` as for ``rollout``.

        ``first_substep``: as in ``Grid``.
        """
        steps = torch.full((first + substeps,), dt, dtype=torch.float64)
        fixed, rows = self.coefficients(_batch(state)), self.substep_inputs(state, prescribed, steps, first_substep)
        if self.torch_parts is None:
            inputs = fixed | _substep_rows(rows, first, first + substeps)
            return self._call(state, compensation, inputs, substeps, checkpoint)
        total: Impulses = {}
        recomputes = checkpoint and may_recompute()
        parts = self.torch_parts.with_frozen_parameters() if recomputes else self.torch_parts
        last = first + substeps
        for begin in range(first, last, SUBSTEPS_PER_CHECKPOINT):
            chunk = range(begin, min(begin + SUBSTEPS_PER_CHECKPOINT, last))
            run = partial(self._run_with_torch, parts, dt, fixed, rows, chunk)
            if recomputes:
                state, compensation, impulses = torch_checkpoint.checkpoint(
                    run, state, compensation, use_reentrant=False
                )
            else:
                state, compensation, impulses = run(state, compensation)
            total = add_impulses(total, impulses)
        return state, compensation, total

    def frames(
        self,
        state: ClothState,
        compensation: Tensor | None,
        steps: Tensor,
        prescribed: Mapping[str, PrescribedMotion],
        frame_ends: tuple[int, ...],
    ) -> list[tuple[ClothState, Tensor | None, Impulses]]:
        """Run substeps as ``rollout_segment`` does, with a result at every frame; only where ``is_plain``.

        Args:
            state: at the start.
            compensation: at the start.
            steps: [substeps] s.
            prescribed: motions by boundary.
            frame_ends: substeps after which there is a frame; impulses are those since the frame before.
        """
        job = self.job(state, steps, prescribed, compensation)._replace(frame_ends=frame_ends)
        results, _ = devices.forward(job)
        frames = []
        for row in zip(*(t.unbind(1) for t in results.values()), strict=True):
            values = dict(zip(results, row, strict=True))
            frames.append(conversion.unflatten_results(self.builder, state, values, _batch(state)))
        last, compensation, impulses = frames[-1]  # its own memory: who keeps the last frame keeps no other
        return [
            *frames[:-1],
            (last.map(torch.clone), None if compensation is None else compensation.clone(), impulses),
        ]

    @property
    def has_tangents(self) -> bool:
        """Whether ``FusedTangents`` supports it."""
        return self.torch_parts is None and not self.is_on_device

    @property
    def is_on_device(self) -> bool:
        """Whether its tensors are on a device other than the CPU."""
        return devices.is_on_device(self.model.mass)

    @property
    def rounding(self) -> Field | None:
        """The result with the compensation in float32, which has no significant digits; None in float64."""
        return None if self.builder.compensation is None else self.builder.compensation.end

    def is_plain(self, state: ClothState, motion: Mapping[str, Trajectory]) -> bool:
        """Return whether the engine runs by itself, on numbers of which nobody wants a derivative."""
        tensors = [state.x, state.v, state.d3, *state.memory.values(), *self.builder.inputs.values()]
        motions = [part for m in motion.values() for part in (m.t, m.pose)]
        return self.torch_parts is None and _are_plain_numbers([*tensors, *motions])

    def job(
        self,
        state: ClothState,
        steps: Tensor,
        prescribed: Mapping[str, PrescribedMotion],
        compensation: Tensor | None = None,
        first_substep: int = 0,
    ) -> Job:
        """Return the program with all numbers of a call; not for models with parts in torch."""
        batch, program = _batch(state), self.builder.program
        inputs = self.coefficients(batch) | self.substep_inputs(state, prescribed, steps, first_substep)
        variables = conversion.state_inputs(self.builder, state, compensation)
        inputs |= conversion.flatten_batch(self.builder, variables, batch)
        return Job(program, {field: inputs[field] for field in program.inputs}, batch.numel(), len(steps))

    def coefficients(self, batch: torch.Size) -> dict[Field, Tensor]:
        """Return the inputs that stay the same over the substeps of a call."""
        if not self._coefficients:
            self._coefficients = conversion.flatten_batch(self.builder, self.builder.inputs, batch)
            if self.torch_parts is not None and may_recompute():  # parameters may have other values by then
                self._coefficients = {field: t.clone() for field, t in self._coefficients.items()}
        return self._coefficients

    def substep_inputs(
        self, state: ClothState, prescribed: Mapping[str, PrescribedMotion], steps: Tensor, first_substep: int
    ) -> dict[Field, Tensor]:
        """Return the inputs with a row for every substep; ``steps``: [substeps] s, ``first_substep`` as in ``Grid``."""
        inputs = {**conversion.prescribed_inputs(self.builder, prescribed), self.builder.dt: steps.unsqueeze(-1)}
        if self.builder.grid_shift is not None:
            inputs[self.builder.grid_shift] = grid_shifts(first_substep, len(steps))
        return conversion.flatten_batch(self.builder, inputs, _batch(state))

    def _run_with_torch(
        self,
        parts: TorchParts,
        dt: float,
        fixed: dict[Field, Tensor],
        rows: dict[Field, Tensor],
        substeps: range,
        state: ClothState,
        compensation: Tensor | None,
    ) -> tuple[ClothState, Tensor | None, Impulses]:
        total: Impulses = {}
        for k in substeps:
            force, memory = parts.force(state, compensation, dt)
            inputs = fixed | _substep_rows(rows, k, k + 1)
            state, compensation, impulses = self._call(state, compensation, inputs, 1, False, force)
            state = state._replace(memory=state.memory | memory)
            total = add_impulses(total, impulses)
        return state, compensation, total

    def _call(
        self,
        state: ClothState,
        compensation: Tensor | None,
        inputs: dict[Field, Tensor],
        substeps: int,
        checkpoint: bool,
        force: Tensor | None = None,
    ) -> tuple[ClothState, Tensor | None, Impulses]:
        builder, program, batch = self.builder, self.builder.program, _batch(state)
        variables = conversion.state_inputs(builder, state, compensation)
        if builder.torch_force is not None and force is not None:
            variables[builder.torch_force] = force
        by_field = inputs | conversion.flatten_batch(builder, variables, batch)
        tensors = [by_field[field] for field in program.inputs]
        if _are_plain_numbers(tensors):
            job = Job(program, dict(zip(program.inputs, tensors, strict=True)), batch.numel(), substeps)
            return conversion.unflatten_results(builder, state, devices.forward(job)[0], batch)
        interval = self._record_interval(batch.numel(), substeps, checkpoint) if _needs_gradient(tensors) else 0
        *outputs, _ = Rollout.apply(program.number, substeps, interval, *tensors)  # type: ignore[misc]
        results = dict(zip(program.outputs, outputs, strict=True))
        return conversion.unflatten_results(builder, state, results, batch)

    def _record_interval(self, scenes: int, substeps: int, checkpoint: bool) -> int:
        """Substeps between records: 1 while the budget lasts; 0: the adjoint makes records itself."""
        if self.is_on_device:
            return 0
        if not checkpoint:
            return 1
        size = execution.full_size(self.builder.program, scenes, substeps)
        if size > self._record_bytes_left:
            return 0
        self._record_bytes_left -= size
        return 1


def rollout(model: Model, state: ClothState, dt: float, prescribed: Mapping[str, PrescribedMotion], substeps: int):
    """Run substeps as ``dynamics.substep.rollout`` does, from substep 0 of the prescribed motions.

    Raises:
        UnsupportedPart: a part has no kernels.
    """
    return FusedEngine(model, state, prescribed).rollout(state, dt, prescribed, substeps)


def _batch(state: ClothState) -> torch.Size:
    return state.x.shape[:-2]


def _substep_rows(rows: Mapping[Field, Tensor], first: int, last: int) -> dict[Field, Tensor]:
    return {field: t[:, first:last].contiguous() for field, t in rows.items()}


def may_recompute() -> bool:
    """Return whether a backward pass may follow that can compute again.

    ``torch.func`` knows no saved tensors, so under its transforms there is none.
    """
    return torch.is_grad_enabled() and not torch._C._are_functorch_transforms_active()


def _are_plain_numbers(tensors: list[Tensor]) -> bool:
    """Whether all are plain tensors without gradients.

    The autograd operator can then be skipped, which costs as much as some tens of substeps.
    """
    return not under_torch_transform() and all(type(t) is Tensor for t in tensors) and not _needs_gradient(tensors)


def _needs_gradient(tensors: list[Tensor]) -> bool:
    return torch.is_grad_enabled() and any(t.requires_grad for t in tensors)
