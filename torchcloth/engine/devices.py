"""A job where its tensors are: on the processor (``running``), or on a CUDA device (``cuda``)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import torch
from torch import Tensor

from ..errors import InvalidInput
from . import execution
from .building import Unbuilt
from .cuda import launch, self_test
from .execution import Job
from .fields import Field
from .program import Program


def elsewhere(tensor: Tensor) -> bool:
    """Whether such tensors are not the processor's."""
    return tensor.is_cuda


def forward(job: Job, every: int = 0, keep: bool = False) -> tuple[dict[Field, Tensor], Tensor]:
    """(nexts and sums [scenes, (frames,) rows, comps], records).

    ``every``: see ``running.forward``. On a device, which goes through all substeps again, records are which triangles
    met others, where ``keep`` says that there will be a reverse sweep.
    """
    return launch.forward(job, keep) if elsewhere(job.like) else execution.forward(job, every)


def reverse(
    job: Job, records: Tensor, every: int, seeds: Mapping[Field, Tensor], wanted: set[Field]
) -> dict[Field, Tensor]:
    """Adjoints [scenes, rows, comps] of the wanted inputs, from those of nexts and sums.

    ``every``: 0: without records.
    """
    if elsewhere(job.like):
        return launch.reverse(job, records, seeds, wanted)
    if every == 0:
        every = execution.spacing(job)
        records = execution.forward(job, every)[1]
    return execution.reverse(job, records.contiguous(), every, seeds, wanted)


def records_like(program: Program, scenes: int, substeps: int, every: int, like: Tensor) -> Tensor:
    """The shape and precision of what ``forward`` gives besides results, without numbers."""
    if elsewhere(like):
        size = launch.mask_size(launch.on_device(program, like.device).source, substeps)
        return like.new_empty(scenes, -(-size // 8), dtype=torch.uint8)
    return like.new_empty(scenes, execution.record_size(program, substeps, every))


def prepare(program: Program, device: torch.device) -> bool:
    """Compile for a device; whether it was tried there.

    Raises:
        Unbuilt: it cannot be, or it failed when it was tried.
    """
    there = launch.on_device(program, device)
    if there.doubt is not None:
        raise Unbuilt(*there.doubt)
    return there.tried


def try_out(jobs: Iterable[Job], rounding: Field | None) -> None:
    """Compare a device with the processor, on jobs of one program until one agrees; see ``trial.agrees``.

    A wrong kernel is always wrong; what lies on a kink, where rounding decides, does so in few of them.

    Raises:
        Unbuilt: none agrees, or the device fails.
    """
    doubt = None
    for job in jobs:
        there, doubt = launch.on_device(job.program, job.like.device), _doubt(job, rounding)
        there.tried, there.doubt = doubt is None, doubt
        if there.tried:
            return
    if doubt is not None:
        raise Unbuilt(*doubt)


def _doubt(job: Job, rounding: Field | None) -> tuple[str, str] | None:
    """What a device does instead, and what to do about it."""
    try:
        if self_test.agrees(job, rounding):
            return None
    except torch.OutOfMemoryError:
        raise
    except (RuntimeError, InvalidInput) as error:
        said = str(error).partition("\n")[0]
        return f"the engine on {_name(job)} fails ({said})", "begin a new process, and please report it"
    return f"the engine on {_name(job)} is not the CPU's", "please report it"


def _name(job: Job) -> str:
    device = job.like.device
    return torch.cuda.get_device_name(device) if device.type == "cuda" else str(device)
