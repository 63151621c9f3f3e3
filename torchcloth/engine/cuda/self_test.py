"""Self-test of a device: it must do as the CPU does, on some substeps and their adjoint."""

from __future__ import annotations

import torch
from torch import Tensor

from .. import execution
from ..enums import FieldKind
from ..execution import Job
from ..fields import Field
from . import launch

# relative to root mean squares; a wrong kernel gives errors of order 1
MAX_RELATIVE_ERROR = {torch.float64: 1e-6, torch.float32: 0.05}
ADJOINT_CHUNK_SUBSTEPS = 5  # so few that the test has several chunks, as longer simulations do
MIN_RMS = 1e-300  # no division by 0
SEED_FLOOR = 1e-3  # of the largest component: a component that stays 0 gets no large seed


def matches_cpu(job: Job, rounding: Field | None) -> bool:
    """Return whether a job gives the same on its device as on the CPU.

    A job that is not finite on the CPU cannot be compared, and counts as the same.

    Args:
        job: the job, with tensors on the device.
        rounding: result with the compensation of the positions, which has no significant digits.
    """
    on_cpu = job._replace(inputs={f: t.cpu() for f, t in job.inputs.items()})
    expected, records = execution.forward(on_cpu, 1)
    if not all(bool(torch.isfinite(t).all()) for t in expected.values()):
        return True
    seeds = {f: torch.zeros_like(t) if f == rounding else _random_seed(t, f.id) for f, t in expected.items()}
    expected_adjoints = execution.reverse(on_cpu, records, 1, seeds, set(on_cpu.inputs))
    values, masks = launch.forward(job)
    device_seeds = {f: t.to(job.like.device) for f, t in seeds.items()}
    adjoints = launch.reverse(job, masks, device_seeds, set(job.inputs), ADJOINT_CHUNK_SUBSTEPS)
    eps = 1e3 * torch.finfo(job.program.dtype).eps
    states = [f for f in job.program.inputs if f.kind == FieldKind.STATE]
    before = dict(zip([f for f in expected if f.kind == FieldKind.NEXT], states, strict=True))
    errors = []
    for f in expected.keys() - {rounding}:
        change = expected[f] - on_cpu.inputs[before[f]] if f in before else expected[f]
        scale = _rms(change) + eps * _rms(expected[f]) + MIN_RMS
        errors.append(_rms(values[f].cpu() - expected[f]) / scale)
    # sizes of the inputs, and of states that begin at 0 those of the results
    sizes = {f: _rms(t) for f, t in on_cpu.inputs.items()}
    sizes |= {now: torch.maximum(sizes[now], _rms(expected[after])) for after, now in before.items()}
    influences = {f: _rms(t) * sizes[f] for f, t in expected_adjoints.items()}
    for f, influence in influences.items():
        error = _rms(adjoints[f].cpu() - expected_adjoints[f]) * sizes[f]
        errors.append(error / (influence + eps * max(influences.values()) + MIN_RMS))
    return bool(torch.stack(errors).max() <= MAX_RELATIVE_ERROR[job.program.dtype])  # False if one is NaN


def _random_seed(values: Tensor, number: int) -> Tensor:
    """Random, and such that components count equally, whatever their units, but for those that stay 0."""
    noise = torch.randn(values.shape, generator=torch.Generator().manual_seed(number), dtype=torch.float64)
    size = values.double().square().mean((0, 1), keepdim=True).sqrt()
    return (noise / torch.maximum(size, SEED_FLOOR * size.amax()).clamp(min=1e-12)).to(values)


def _rms(values: Tensor) -> Tensor:
    return values.double().square().mean().sqrt()
