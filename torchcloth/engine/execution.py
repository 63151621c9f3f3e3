"""Running a program on tensors: values, adjoints, tangents."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import NamedTuple

import torch
from torch import Tensor

from .enums import FieldKind, RunMode
from .fields import Field
from .library import Port, RunCall
from .program import Program
from .record_buffer_pool import RecordBufferPool

RECORD_BUDGET_BYTES = 192 * 2**20  # records that a simulation keeps for its adjoint
RECORD_BUFFERS = RecordBufferPool(RECORD_BUDGET_BYTES)
RECOMPUTE_BUDGET_BYTES = 96 * 2**20  # records that the adjoint makes at a time when it repeats substeps
RECORD_ALIGNMENT_BYTES = 64
MIN_FILLED_LANES = 0.75  # share of a pack's lanes that scenes fill; with fewer, scenes cost less one by one
MIN_OPS_PER_THREAD = 8e5  # operations of a substep that make another thread worth while: some 20 us


class Job(NamedTuple):
    """A program with the numbers that it runs on.

    Attributes:
        program: what one substep does.
        inputs: parameters, states and inputs per substep; each [scenes or 1, rows or substeps, comps].
        scenes: simulations of one call.
        substeps: substeps of each.
        frame_ends: substeps after which values have results, the last one after all; (): only after all.
    """

    program: Program
    inputs: Mapping[Field, Tensor]
    scenes: int
    substeps: int
    frame_ends: tuple[int, ...] = ()

    @property
    def like(self) -> Tensor:
        """A tensor with the job's precision and device."""
        return next(iter(self.inputs.values()))

    @property
    def frames(self) -> tuple[int, ...]:
        """Axis of the results between scenes and rows; () where there is one result."""
        return (len(self.frame_ends),) if self.frame_ends else ()


def forward(job: Job, record_interval: int = 0) -> tuple[dict[Field, Tensor], Tensor]:
    """Run the substeps.

    Args:
        job: program and numbers.
        record_interval: substeps between records; 0: no records.

    Returns:
        States after the substeps and sums [scenes, (frames,) rows, comps], and the records.
    """
    like = job.like
    results = {f: like.new_empty(job.scenes, *job.frames, f.rows, f.comps) for f in job.program.outputs}
    size = record_size(job.program, job.substeps, record_interval)
    records = RECORD_BUFFERS.acquire(job.scenes, size, dtype=like.dtype)
    ports = _ports(job)
    for f, tensor in results.items():
        ports[f.id].result = tensor.data_ptr()
    _run(job, ports, RunMode.VALUES, records, record_interval)
    return results, records


def reverse(
    job: Job, records: Tensor, record_interval: int, seeds: Mapping[Field, Tensor], wanted: set[Field]
) -> dict[Field, Tensor]:
    """Return the adjoints [scenes, rows, comps] of the wanted inputs, from those of the results (``seeds``)."""
    if records.data_ptr() % RECORD_ALIGNMENT_BYTES:  # a hook for saved tensors returned them in other memory
        records = records.clone()
    like = job.like
    gradients = {f: like.new_zeros(job.scenes, *job.inputs[f].shape[1:]) for f in wanted}
    ports = _ports(job)
    for f, tensor in seeds.items():
        ports[f.id].seed = tensor.data_ptr()
    for f, tensor in gradients.items():
        ports[f.id].gradient = tensor.data_ptr()
    _run(job, ports, RunMode.ADJOINTS, records, record_interval)
    return gradients


def tangent(
    job: Job, tangents: Mapping[Field, Tensor], directions: int
) -> tuple[dict[Field, Tensor], dict[Field, Tensor]]:
    """Run the substeps with tangents.

    Args:
        job: program and numbers.
        tangents: of inputs, each [scenes or 1, directions, rows or substeps, comps].
        directions: how many.

    Returns:
        The results [scenes, rows, comps] and their tangents [scenes, directions, rows, comps].
    """
    like = job.like
    results = {f: like.new_empty(job.scenes, f.rows, f.comps) for f in job.program.outputs}
    result_tangents = {f: like.new_empty(job.scenes, directions, f.rows, f.comps) for f in results}
    ports = _ports(job)
    for f, tensor in results.items():
        ports[f.id].result, ports[f.id].result_tangent = tensor.data_ptr(), result_tangents[f].data_ptr()
    for f, tensor in tangents.items():
        ports[f.id].tangent, ports[f.id].tangent_stride = tensor.data_ptr(), _scene_stride(tensor)
    _run(job, ports, RunMode.TANGENTS, like, 0, directions)
    return results, result_tangents


@contextmanager
def min_filled_lanes(share: float) -> Iterator[None]:
    """Let scenes share the lanes of packs from another ``share`` of filled lanes on; above 1 they never do."""
    global MIN_FILLED_LANES
    before, MIN_FILLED_LANES = MIN_FILLED_LANES, share
    try:
        yield
    finally:
        MIN_FILLED_LANES = before


def checkpoint_interval(job: Job) -> int:
    """Return the substeps between records that the adjoint makes: 1 if they fit, else about the root of all."""
    if full_size(job.program, job.scenes, job.substeps) <= RECOMPUTE_BUDGET_BYTES:
        return 1
    states = job.scenes * job.substeps * job.program.record_size(False) * job.program.dtype.itemsize
    return max(int(job.substeps**0.5), min(states // max(RECOMPUTE_BUDGET_BYTES, 1), job.substeps), 2)


def full_size(program: Program, scenes: int, substeps: int) -> int:
    """Return the size [bytes] of the records of all substeps."""
    return scenes * record_size(program, substeps, 1) * program.dtype.itemsize


def record_size(program: Program, substeps: int, record_interval: int) -> int:
    """Return the count of numbers in the records of one scene."""
    return 0 if record_interval == 0 else program.records_size(substeps, record_interval)


def _scene_stride(tensor: Tensor) -> int:
    """Numbers between scenes; 0 where all share one."""
    return tensor[0].numel() if len(tensor) > 1 else 0


def _ports(job: Job):
    ports = (Port * len(job.program.fields))()
    for f, tensor in job.inputs.items():
        shape = (job.substeps if f.kind == FieldKind.PER_SUBSTEP else f.rows, f.comps)
        if not tensor.is_contiguous() or tensor.dtype != job.program.dtype:
            raise ValueError(f"{f}: not contiguous or of another precision")
        if tensor.shape[1:] != shape or len(tensor) not in (1, job.scenes):
            raise ValueError(
                f"{f}: got shape {list(tensor.shape)}, expected [1 or {job.scenes}, {shape[0]}, {shape[1]}]"
            )
        ports[f.id].value, ports[f.id].stride = tensor.data_ptr(), _scene_stride(tensor)
    return ports


def _run(job: Job, ports, mode: RunMode, records: Tensor, record_interval: int, directions: int = 0) -> None:
    ends = job.frame_ends or (job.substeps,)
    call = RunCall(
        ports=ctypes.cast(ports, ctypes.POINTER(Port)),
        scenes=job.scenes,
        substeps=job.substeps,
        directions=directions,
        threads=torch.get_num_threads(),
        records=records.data_ptr(),
        record_interval=record_interval,
        min_ops_per_thread=MIN_OPS_PER_THREAD,
        frame_ends=(ctypes.c_int64 * len(ends))(*ends),
        frames=len(ends),
        min_filled_lanes=MIN_FILLED_LANES,
    )
    job.program.run(call, mode)
