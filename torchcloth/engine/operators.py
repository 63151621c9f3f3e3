"""The engine as operators of torch: ``torchcloth::rollout``, its adjoint and its tangents.

An operator takes a program by its number (``Program.number``); the caller must keep the program alive. Inputs are
[scenes or 1, rows or substeps, components] in the order of ``Program.inputs``, results in that of ``Program.outputs``.
First derivatives are exact in both modes and under ``vmap``; second ones are refused.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NoReturn, cast

import torch
from torch import Tensor

from ..errors import InvalidInput
from . import devices, execution
from .execution import Job
from .program import program_by_number

BatchDims = list[int | None]  # vmap's axis of every tensor

# torch.library.custom_op would do the same, but imports a second's worth of compiler at the first call
for schema in (
    "rollout(int program, int substeps, int record_interval, Tensor[] inputs) -> Tensor[]",
    "rollout_backward(int program, int substeps, int record_interval, Tensor[] inputs, Tensor records, "
    "Tensor[] seeds, int[] wanted) -> Tensor[]",
    "rollout_tangent(int program, int substeps, Tensor[] inputs, Tensor[] tangents, int[] moved) -> Tensor[]",
):
    torch.library.define(f"torchcloth::{schema.partition('(')[0]}", "(" + schema.partition("(")[2])
ops = torch.ops.torchcloth
_on_cpu = cast("Callable[[str], Callable]", partial(torch.library.impl, types="CPU"))
_on_any_device = cast("Callable[[str], Callable]", partial(torch.library.impl, types=("CPU", "CUDA")))
_vmap_rule = cast("Callable[[str], Callable]", torch.library.register_vmap)


def _job(program: int, substeps: int, inputs: Sequence[Tensor]) -> Job:
    numbered = program_by_number(program)
    values = dict(zip(numbered.inputs, (t.contiguous() for t in inputs), strict=True))
    return Job(numbered, values, _scenes(inputs), substeps)


def _scenes(inputs: Sequence[Tensor]) -> int:
    return max(len(t) for t in inputs)


# -- values -----------------------------------------------------------------------------------------------------------


@_on_any_device("torchcloth::rollout")
def _rollout(program: int, substeps: int, record_interval: int, inputs: Sequence[Tensor]) -> list[Tensor]:
    """Results after the substeps [scenes, rows, components], and the records for the adjoint.

    ``record_interval``: substeps between records; 0: none, the adjoint repeats the substeps.
    """
    results, records = devices.forward(_job(program, substeps, inputs), record_interval, keep_masks=True)
    return [*results.values(), records]


@torch.library.register_fake("torchcloth::rollout")
def _(program: int, substeps: int, record_interval: int, inputs: Sequence[Tensor]) -> list[Tensor]:
    numbered, scenes = program_by_number(program), _scenes(inputs)
    results = [inputs[0].new_empty(scenes, f.rows, f.comps) for f in numbered.outputs]
    return [*results, devices.empty_records(numbered, scenes, substeps, record_interval, inputs[0])]


@_vmap_rule("torchcloth::rollout")
def _(info: Any, dims: Any, program: int, substeps: int, record_interval: int, inputs: Sequence[Tensor]):
    scenes = _inner_scenes(inputs, dims[3])
    flat = [_fold(t, d, info.batch_size, scenes) for t, d in zip(inputs, dims[3], strict=True)]
    results = ops.rollout(program, substeps, record_interval, flat)
    return [_unfold(t, info.batch_size) for t in results], [0] * len(results)


# -- reverse mode -----------------------------------------------------------------------------------------------------


@_on_any_device("torchcloth::rollout_backward")
def _rollout_backward(
    program: int,
    substeps: int,
    record_interval: int,
    inputs: Sequence[Tensor],
    records: Tensor,
    seeds: Sequence[Tensor],
    wanted: Sequence[int],
) -> list[Tensor]:
    """Adjoints of the ``wanted`` inputs, each in its input's shape, from the seeds of all results."""
    job = _job(program, substeps, inputs)
    fields = job.program.inputs
    by_field = dict(zip(job.program.outputs, (s.to(job.program.dtype).contiguous() for s in seeds), strict=True))
    adjoints = devices.reverse(job, records, record_interval, by_field, {fields[i] for i in wanted})
    grads = [adjoints[fields[i]] for i in wanted]
    return [g.sum(0, keepdim=True) if len(inputs[i]) < len(g) else g for i, g in zip(wanted, grads, strict=True)]


@torch.library.register_fake("torchcloth::rollout_backward")
def _(program, substeps, record_interval, inputs, records, seeds, wanted) -> list[Tensor]:
    return [torch.empty_like(inputs[i], memory_format=torch.contiguous_format) for i in wanted]


@_vmap_rule("torchcloth::rollout_backward")
def _(info: Any, dims: Any, program, substeps, record_interval, inputs, records, seeds, wanted):
    size, scenes = info.batch_size, _inner_scenes(inputs, dims[3])
    # an input that many scenes share gets a copy for each, so that their adjoints stay apart
    flat = [_fold(t, d, size, scenes, i in wanted) for i, (t, d) in enumerate(zip(inputs, dims[3], strict=True))]
    flat_records = _fold(records, dims[4], size, scenes, True)
    flat_seeds = [_fold(t, d, size, scenes, True) for t, d in zip(seeds, dims[5], strict=True)]
    grads = ops.rollout_backward(program, substeps, record_interval, flat, flat_records, flat_seeds, wanted)
    grads = [_unfold(g, size) for g in grads]
    shared = [scenes > 1 and inputs[i].shape[_scene_axis(dims[3][i])] == 1 for i in wanted]
    return [g.sum(1, keepdim=True) if s else g for g, s in zip(grads, shared, strict=True)], [0] * len(grads)


# -- forward mode -----------------------------------------------------------------------------------------------------


@_on_cpu("torchcloth::rollout_tangent")
def _rollout_tangent(
    program: int, substeps: int, inputs: Sequence[Tensor], tangents: Sequence[Tensor], moved: Sequence[int]
) -> list[Tensor]:
    """Results, and then their tangents [scenes, directions, rows, components].

    ``tangents``: of the inputs ``moved``, each [scenes or 1, directions, rows or substeps, components].
    """
    job = _job(program, substeps, inputs)
    fields = job.program.inputs
    dtype = job.program.dtype  # torch.func.jvp makes float64 of a Python number times a scalar
    by_field = {fields[i]: t.to(dtype).contiguous() for i, t in zip(moved, tangents, strict=True)}
    results, result_tangents = execution.tangent(job, by_field, tangents[0].shape[1])
    return [*results.values(), *result_tangents.values()]


@torch.library.register_fake("torchcloth::rollout_tangent")
def _(program: int, substeps: int, inputs: Sequence[Tensor], tangents: Sequence[Tensor], moved: Sequence[int]):
    fields, like, scenes = program_by_number(program).outputs, inputs[0], _scenes(inputs)
    results = [like.new_empty(scenes, f.rows, f.comps) for f in fields]
    return [*results, *(like.new_empty(scenes, tangents[0].shape[1], f.rows, f.comps) for f in fields)]


@_vmap_rule("torchcloth::rollout_tangent")
def _(info: Any, dims: Any, program, substeps, inputs, tangents, moved):
    size = info.batch_size
    if all(d is None for d in dims[2]):  # many tangents at one place become directions
        return _vmap_directions(size, dims[3], program, substeps, inputs, tangents, moved)
    scenes = _inner_scenes(inputs, dims[2])
    flat = [_fold(t, d, size, scenes) for t, d in zip(inputs, dims[2], strict=True)]
    flat_tangents = [_fold(t, d, size, scenes) for t, d in zip(tangents, dims[3], strict=True)]
    results = ops.rollout_tangent(program, substeps, flat, flat_tangents, moved)
    return [_unfold(t, size) for t in results], [0] * len(results)


def _vmap_directions(size: int, dims: BatchDims, program: int, substeps: int, inputs, tangents, moved):
    first = [t.expand(size, *t.shape) if d is None else t.movedim(d, 0) for t, d in zip(tangents, dims, strict=True)]
    results = ops.rollout_tangent(program, substeps, inputs, [t.movedim(0, 1).flatten(1, 2) for t in first], moved)
    half = len(results) // 2
    values = [t.expand(size, *t.shape) for t in results[:half]]
    return [*values, *(t.unflatten(1, (size, -1)).movedim(1, 0) for t in results[half:])], [0] * len(results)


# -- helpers of the above ---------------------------------------------------------------------------------------------


def _scene_axis(dim: int | None) -> int:
    """Axis of the scenes, next to vmap's."""
    return 1 if dim == 0 else 0


def _inner_scenes(inputs: Sequence[Tensor], dims: BatchDims) -> int:
    return max(t.shape[_scene_axis(d)] for t, d in zip(inputs, dims, strict=True))


def _fold(t: Tensor, dim: int | None, size: int, scenes: int, always: bool = False) -> Tensor:
    """vmap's axis becomes scenes; a tensor that all scenes share is not copied, unless ``always``."""
    if dim is None:
        if len(t) == 1 and not always:
            return t
        t, dim = t.expand(size, *t.shape), 0
    t = t.movedim(dim, 0)
    return t.expand(size, scenes, *t.shape[2:]).flatten(0, 1)


def _unfold(t: Tensor, size: int) -> Tensor:
    return t.unflatten(0, (size, -1))


def _save_for_backward(ctx: Any, inputs: tuple[Any, ...], output: Sequence[Tensor]) -> None:
    ctx.number, ctx.substeps, ctx.record_interval, tensors = inputs
    ctx.program, ctx.count = program_by_number(ctx.number), len(tensors)  # alive as long as the graph is
    ctx.save_for_backward(*tensors, output[-1])


def _backward(ctx: Any, seeds: Sequence[Tensor | None], needs: Sequence[bool]) -> list[Tensor | None]:
    *inputs, records = ctx.saved_tensors
    scenes, wanted = _scenes(inputs), [i for i, need in enumerate(needs) if need]
    fields = ctx.program.outputs
    like = inputs[0]
    dense = [
        like.new_zeros(scenes, f.rows, f.comps) if s is None else s for f, s in zip(fields, seeds[:-1], strict=True)
    ]
    count, arguments = len(inputs), (ctx.number, ctx.substeps, ctx.record_interval)

    def work(*t: Tensor) -> list[Tensor]:
        return ops.rollout_backward(*arguments, t[:count], t[count], t[count + 1 :], wanted)

    adjoints = _OnceDifferentiable.apply(work, *inputs, records, *dense)
    grads: list[Tensor | None] = [None] * len(inputs)
    for i, grad in zip(wanted, adjoints, strict=True):
        grads[i] = grad
    return grads


def _op_backward(ctx: Any, seeds: Sequence[Tensor | None]):
    return None, None, None, _backward(ctx, seeds, [t.requires_grad for t in ctx.saved_tensors[:-1]])


def _refuse(ctx: Any, *seeds: Any) -> NoReturn:
    raise InvalidInput(
        "second derivatives",
        got="a derivative of the fused engine's gradient or tangent",
        expected="first derivatives",
        remedy='use tc.Cloth(..., engine="reference")',
    )


torch.library.register_autograd("torchcloth::rollout", _op_backward, setup_context=_save_for_backward)
torch.library.register_autograd("torchcloth::rollout_backward", _refuse)
torch.library.register_autograd("torchcloth::rollout_tangent", _refuse)


class _OnceDifferentiable(torch.autograd.Function):
    """Work on tensors that has no derivative of its own in either mode, under any transform."""

    generate_vmap_rule = True

    @staticmethod
    def forward(work: Callable[..., list[Tensor]], *tensors: Tensor) -> tuple[Tensor, ...]:  # pyright: ignore
        """Do the work."""
        return tuple(work(*tensors))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        """Save nothing, because no derivative follows."""

    backward = jvp = staticmethod(_refuse)  # type: ignore[assignment]


class Rollout(torch.autograd.Function):
    """The operator with forward mode, which torch.library has no place for."""

    generate_vmap_rule = True

    @staticmethod
    def forward(program: int, substeps: int, record_interval: int, *inputs: Tensor) -> tuple[Tensor, ...]:  # pyright: ignore
        """Run the operator ``rollout``."""
        return tuple(ops.rollout(program, substeps, record_interval, inputs))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        """Save what both modes need."""
        program, substeps, record_interval, *tensors = inputs
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(output[-1])
        _save_for_backward(ctx, (program, substeps, record_interval, tensors), output)
        ctx.save_for_forward(*tensors, output[-1])

    @staticmethod
    def backward(ctx: Any, *seeds: Tensor | None):  # pyright: ignore[reportIncompatibleMethodOverride]
        """Return the adjoints of the inputs."""
        return None, None, None, *_backward(ctx, seeds, ctx.needs_input_grad[3:])

    @staticmethod
    def jvp(ctx: Any, *tangents: Tensor | None):  # pyright: ignore[reportIncompatibleMethodOverride]
        """Return the tangents of the results."""
        *inputs, _ = ctx.saved_tensors
        moved = [i for i, t in enumerate(tangents[3:]) if t is not None]
        along = [t.unsqueeze(1) for t in tangents[3:] if t is not None]
        number, substeps, count = ctx.number, ctx.substeps, len(inputs)

        def work(*t: Tensor) -> list[Tensor]:
            return ops.rollout_tangent(number, substeps, t[:count], t[count:], moved)

        results = _OnceDifferentiable.apply(work, *inputs, *along)
        return *(t.squeeze(1) for t in results[len(results) // 2 :]), None
