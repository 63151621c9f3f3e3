"""A job on the device of its tensors: on the CPU (``execution``), or on a CUDA device (``cuda``)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import torch
from torch import Tensor

from ..errors import InvalidInput
from . import execution
from .building import EngineUnavailable
from .cuda import launch, self_test
from .execution import Job
from .fields import Field
from .program import Program


def is_on_device(tensor: Tensor) -> bool:
    """Return whether a tensor is on a CUDA device."""
    return tensor.is_cuda


def forward(job: Job, record_interval: int = 0, keep_masks: bool = False) -> tuple[dict[Field, Tensor], Tensor]:
    """Run the substeps; arguments and results as of ``execution.forward``.

    On a device, where the adjoint repeats all substeps, the records are only the masks of the triangles in contact.
    ``keep_masks``: a reverse sweep will need them.
    """
    return launch.forward(job, keep_masks) if is_on_device(job.like) else execution.forward(job, record_interval)


def reverse(
    job: Job, records: Tensor, record_interval: int, seeds: Mapping[Field, Tensor], wanted: set[Field]
) -> dict[Field, Tensor]:
    """Return the adjoints [scenes, rows, comps] of the wanted inputs, from those of the results (``seeds``).

    ``record_interval``: 0: there are no records, and the sweep makes them.
    """
    if is_on_device(job.like):
        return launch.reverse(job, records, seeds, wanted)
    if record_interval == 0:
        record_interval = execution.checkpoint_interval(job)
        records = execution.forward(job, record_interval)[1]
    return execution.reverse(job, records.contiguous(), record_interval, seeds, wanted)


def empty_records(program: Program, scenes: int, substeps: int, record_interval: int, like: Tensor) -> Tensor:
    """Return a tensor with the shape and precision of the records of ``forward``."""
    if is_on_device(like):
        size = launch.mask_size(launch.device_program(program, like.device).module, substeps)
        return like.new_empty(scenes, -(-size // 8), dtype=torch.uint8)
    return like.new_empty(scenes, execution.record_size(program, substeps, record_interval))


def prepare(program: Program, device: torch.device) -> bool:
    """Compile a program for a device; return whether it passed the self-test there.

    Raises:
        EngineUnavailable: it cannot be compiled, or it failed the self-test.
    """
    compiled = launch.device_program(program, device)
    if compiled.failure is not None:
        raise EngineUnavailable(*compiled.failure)
    return compiled.passed_self_test


def run_self_test(jobs: Iterable[Job], rounding: Field | None) -> None:
    """Compare a device with the CPU on jobs of one program until one agrees; see ``self_test.matches_cpu``.

    A wrong kernel is wrong on all jobs. A state on a kink, where rounding decides, is rare.

    Raises:
        EngineUnavailable: no job agrees, or the device fails.
    """
    failure = None
    for job in jobs:
        compiled = launch.device_program(job.program, job.like.device)
        failure = _self_test_failure(job, rounding)
        compiled.passed_self_test, compiled.failure = failure is None, failure
        if compiled.passed_self_test:
            return
    if failure is not None:
        raise EngineUnavailable(*failure)


def _self_test_failure(job: Job, rounding: Field | None) -> tuple[str, str] | None:
    """What a device does wrong, and what the user can do about it."""
    try:
        if self_test.matches_cpu(job, rounding):
            return None
    except torch.OutOfMemoryError:
        raise
    except (RuntimeError, InvalidInput) as error:
        message = str(error).partition("\n")[0]
        return f"the engine on {_device_name(job)} fails ({message})", "begin a new process, and please report it"
    return f"the engine on {_device_name(job)} is not the CPU's", "please report it"


def _device_name(job: Job) -> str:
    device = job.like.device
    return torch.cuda.get_device_name(device) if device.type == "cuda" else str(device)
