"""A job where its tensors are: on the processor (``running``), or on a CUDA device (``cuda``)."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from . import running
from .building import Unbuilt
from .cuda import runs, trial
from .fields import Field
from .program import Program
from .running import Job


def elsewhere(tensor: Tensor) -> bool:
    """Whether such tensors are not the processor's."""
    return tensor.is_cuda


def forward(job: Job, every: int = 0, keep: bool = False) -> tuple[dict[Field, Tensor], Tensor]:
    """(nexts and sums [scenes, (frames,) rows, comps], records).

    ``every``: see ``running.forward``. On a device, which goes through all substeps again, records are which triangles
    met others, where ``keep`` says that there will be a reverse sweep.
    """
    return runs.forward(job, keep) if elsewhere(job.like) else running.forward(job, every)


def reverse(
    job: Job, records: Tensor, every: int, seeds: Mapping[Field, Tensor], wanted: set[Field]
) -> dict[Field, Tensor]:
    """Adjoints [scenes, rows, comps] of the wanted inputs, from those of nexts and sums.

    ``every``: 0: without records.
    """
    if elsewhere(job.like):
        return runs.reverse(job, records, seeds, wanted)
    if every == 0:
        every = running.spacing(job)
        records = running.forward(job, every)[1]
    return running.reverse(job, records.contiguous(), every, seeds, wanted)


def records_like(program: Program, scenes: int, substeps: int, every: int, like: Tensor) -> Tensor:
    """The shape and precision of what ``forward`` gives besides results, without numbers."""
    if elsewhere(like):
        size = runs.mask_size(runs.on_device(program, like.device).source, substeps)
        return like.new_empty(scenes, -(-size // 8), dtype=torch.uint8)
    return like.new_empty(scenes, running.record_size(program, substeps, every))


def prepare(program: Program, device: torch.device) -> bool:
    """Compile for a device; whether it was tried there.

    Raises:
        Unbuilt: it cannot be, or it failed when it was tried.
    """
    there = runs.on_device(program, device)
    if there.doubt is not None:
        raise Unbuilt(str(there.doubt), there.doubt.remedy)
    return there.tried


def try_out(job: Job, rounding: Field | None) -> None:
    """Compare a job's device with the processor; see ``trial.check``.

    Raises:
        Unbuilt: they do not agree.
    """
    there = runs.on_device(job.program, job.like.device)
    try:
        trial.check(job, rounding)
    except Unbuilt as miss:
        there.doubt = miss
        raise
    there.tried = True
