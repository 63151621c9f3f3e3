"""Running a program on tensors: values, adjoints, tangents."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from .fields import Field, Kind
from .library import Call, Port
from .program import Program
from .record_buffer_pool import Pool

BUDGET = 192 * 2**20  # bytes of records that a simulation keeps for its adjoint
MEMORY = Pool(BUDGET)
ANEW = 96 * 2**20  # bytes of records that the adjoint makes at a time, of substeps that it goes through again
ALIGNED = 64  # bytes
WORTH = 8e5  # operations of a substep for which another thread is worth while: some 20 us


class Job(NamedTuple):
    """A program with the numbers it runs on; every tensor is [scenes or 1, rows or substeps, comps]."""

    program: Program
    inputs: Mapping[Field, Tensor]  # parameters, states, drives
    scenes: int
    substeps: int
    ends: tuple[int, ...] = ()  # of values: substeps after which there are results, the last after all; (): only then

    @property
    def like(self) -> Tensor:
        """Of its precision, where it is."""
        return next(iter(self.inputs.values()))

    @property
    def frames(self) -> tuple[int, ...]:
        """Axis of the results, between scenes and rows; () where they come once."""
        return (len(self.ends),) if self.ends else ()


def forward(job: Job, every: int = 0) -> tuple[dict[Field, Tensor], Tensor]:
    """(nexts and sums [scenes, (frames,) rows, comps], records); ``every``: substeps between records, 0 for none."""
    like = job.like
    results = {f: like.new_empty(job.scenes, *job.frames, f.rows, f.comps) for f in job.program.outputs}
    records = MEMORY.lend(job.scenes, record_size(job.program, job.substeps, every), dtype=like.dtype)
    ports = _ports(job)
    for f, tensor in results.items():
        ports[f.id].result = tensor.data_ptr()
    _run(job, ports, 0, records, every)
    return results, records


def reverse(
    job: Job, records: Tensor, every: int, seeds: Mapping[Field, Tensor], wanted: set[Field]
) -> dict[Field, Tensor]:
    """Adjoints [scenes, rows, comps] of the wanted inputs, from those of nexts and sums."""
    if records.data_ptr() % ALIGNED:  # a hook kept them, and gives them back from elsewhere
        records = records.clone()
    like = job.like
    grads = {f: like.new_zeros(job.scenes, *job.inputs[f].shape[1:]) for f in wanted}
    ports = _ports(job)
    for f, tensor in seeds.items():
        ports[f.id].seed = tensor.data_ptr()
    for f, tensor in grads.items():
        ports[f.id].gradient = tensor.data_ptr()
    _run(job, ports, 1, records, every)
    return grads


def tangent(job: Job, dots: Mapping[Field, Tensor], directions: int) -> tuple[dict[Field, Tensor], dict[Field, Tensor]]:
    """(nexts and sums, their tangents [scenes, directions, rows, comps]) of inputs [scenes or 1, directions, ...]."""
    like = job.like
    results = {f: like.new_empty(job.scenes, f.rows, f.comps) for f in job.program.outputs}
    moved = {f: like.new_empty(job.scenes, directions, f.rows, f.comps) for f in results}
    ports = _ports(job)
    for f, tensor in results.items():
        ports[f.id].result, ports[f.id].dot_result = tensor.data_ptr(), moved[f].data_ptr()
    for f, tensor in dots.items():
        ports[f.id].dot, ports[f.id].dot_stride = tensor.data_ptr(), tensor[0].numel() if len(tensor) > 1 else 0
    _run(job, ports, 2, like, 0, directions)
    return results, moved


def spacing(job: Job) -> int:
    """Substeps between records made anew: every one if they fit, else about the square root of all."""
    if full_size(job.program, job.scenes, job.substeps) <= ANEW:
        return 1
    states = job.scenes * job.substeps * job.program.record_size(False) * job.program.dtype.itemsize
    return max(int(job.substeps**0.5), min(states // max(ANEW, 1), job.substeps), 2)


def full_size(program: Program, scenes: int, substeps: int) -> int:
    """Bytes of the records of all substeps."""
    return scenes * record_size(program, substeps, 1) * program.dtype.itemsize


def record_size(program: Program, substeps: int, every: int) -> int:
    """Numbers of the records of one scene."""
    return 0 if every == 0 else program.records_size(substeps, every)


def _ports(job: Job):
    ports = (Port * len(job.program.fields))()
    for f, tensor in job.inputs.items():
        shape = (job.substeps if f.kind == Kind.DRIVE else f.rows, f.comps)
        if not tensor.is_contiguous() or tensor.dtype != job.program.dtype:
            raise ValueError(f"{f}: not contiguous or of another precision")
        if tensor.shape[1:] != shape or len(tensor) not in (1, job.scenes):
            raise ValueError(
                f"{f}: got shape {list(tensor.shape)}, expected [1 or {job.scenes}, {shape[0]}, {shape[1]}]"
            )
        ports[f.id].value, ports[f.id].stride = tensor.data_ptr(), tensor[0].numel() if len(tensor) > 1 else 0
    return ports


def _run(job: Job, ports, mode: int, records: Tensor, every: int, directions: int = 0) -> None:
    threads = torch.get_num_threads()
    pointer = ctypes.cast(ports, ctypes.POINTER(Port))
    ends = job.ends or (job.substeps,)
    marks = (ctypes.c_int64 * len(ends))(*ends)
    numbers = (job.scenes, job.substeps, directions, threads, records.data_ptr(), every, WORTH, marks, len(ends))
    job.program.run(Call(pointer, *numbers), mode)
