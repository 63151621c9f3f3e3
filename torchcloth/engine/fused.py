"""The fused engine in the place of ``functional.rollout``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from ..boundaries import Drive
from ..dynamics import Impulses
from ..model import Model
from ..types import ClothState
from . import running
from .lowering import DIRECTORS, Lowering, lower, remembered
from .program import Field
from .running import Job


def rollout(model: Model, state: ClothState, dt: float, drives: Mapping[str, Drive], substeps: int):
    """As ``functional.rollout``, from substep 0 of the drives; differentiable in reverse mode.

    Raises:
        Unfused: a part without kernels.
    """
    low = lower(model, state, drives)
    batch = state.x.shape[:-2]
    tensors = _inputs(low, state, dt, drives)
    results = _Rollout.apply(low, substeps, len(batch), *_flat(tensors, batch))
    return _outcome(low, state, results, batch)


class _Rollout(torch.autograd.Function):
    """Inputs [scenes or 1, rows, comps] in the order of ``_inputs``; outputs nexts and sums."""

    @staticmethod
    def forward(ctx: Any, low: Lowering, substeps: int, dims: int, *values: Tensor):
        job = _job(low, substeps, values)
        every = running.spacing(job) if any(ctx.needs_input_grad) else 0
        results, records = running.forward(job, every)
        ctx.low, ctx.substeps, ctx.every = low, substeps, every
        ctx.save_for_backward(*values, records)
        return tuple(results.values())

    @staticmethod
    def backward(ctx: Any, *seeds: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        *values, records = ctx.saved_tensors
        job = _job(ctx.low, ctx.substeps, values)
        given = dict(zip(running.outputs(job.program), (s.contiguous() for s in seeds), strict=True))
        wanted = {f for f, needs in zip(job.inputs, ctx.needs_input_grad[3:], strict=True) if needs}
        found = running.reverse(job, records, ctx.every, given, wanted)
        grads = [None if f not in wanted else _summed(found[f], job.inputs[f]) for f in job.inputs]
        return None, None, None, *grads


def _summed(grad: Tensor, like: Tensor) -> Tensor:
    return grad if len(like) == len(grad) else grad.sum(0, keepdim=True)


def _job(low: Lowering, substeps: int, values) -> Job:
    fields = [*_fields(low)]
    scenes = max(len(value) for value in values)
    return Job(low.program, dict(zip(fields, values, strict=True)), scenes, substeps)


def _fields(low: Lowering) -> list[Field]:
    drives = [field for motion in low.drives.values() for field in motion]
    return [low.x.now, low.v.now, *(s.now for s in low.memory.values()), low.dt, *low.inputs, *drives]


def _inputs(low: Lowering, state: ClothState, dt: float, drives: Mapping[str, Drive]) -> list[Tensor]:
    step = torch.full((1, 1), dt, dtype=state.x.dtype)
    moves = [tensor for drive in drives.values() for tensor in _moves(drive, state.x)]
    return [state.x, state.v, *remembered(low.model, state).values(), step, *low.inputs.values(), *moves]


def _moves(drive: Drive, like: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Rows of the fields of a ``lowering.Motion``."""
    closed = torch.tensor(drive.closed).to(like).unsqueeze(-1)
    return drive.increment.flatten(-2), drive.pose.flatten(-2), closed


def _flat(tensors: list[Tensor], batch: torch.Size) -> list[Tensor]:
    """[scenes or 1, rows, comps] each."""
    out = []
    for t in tensors:
        alone = t.ndim == 2 or t.shape[:-2].numel() == 1
        full = t.reshape(1, *t.shape[-2:]) if alone else t.expand(*batch, *t.shape[-2:]).reshape(-1, *t.shape[-2:])
        out.append(full.contiguous())
    if batch.numel() > 1:
        out[:2] = [t.expand(batch.numel(), -1, -1).contiguous() for t in out[:2]]
    return out


def _outcome(
    low: Lowering, state: ClothState, results: tuple[Tensor, ...], batch: torch.Size
) -> tuple[ClothState, Impulses]:
    by_field = dict(zip(running.outputs(low.program), results, strict=True))
    shaped = {f: t.reshape(*batch, *t.shape[-2:]) for f, t in by_field.items()}
    memory = {key: shaped[s.after] for key, s in low.memory.items()}
    impulses = {name: shaped[f].squeeze(-2) for name, f in low.impulses.items()}
    d3 = memory.pop(DIRECTORS, state.d3)
    return ClothState(shaped[low.x.after], shaped[low.v.after], d3, memory), impulses
