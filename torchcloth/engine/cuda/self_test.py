"""A device is believed after it did what the processor does: some substeps, and their adjoint."""

from __future__ import annotations

import torch
from torch import Tensor

from .. import execution
from ..execution import Job
from ..fields import Field, Kind
from . import launch

MARKS = {torch.float64: 1e-6, torch.float32: 0.05}  # of the root mean squares; what goes wrong there is of order 1
CHUNK = 5  # substeps that an adjoint keeps at a time: it comes to chunks in longer simulations as well
TINY = 1e-300


def agrees(job: Job, rounding: Field | None) -> bool:
    """Whether a job gives on its device what it gives here; one that is not finite here tells nothing.

    ``rounding``: the result that holds what was lost in it, which has no digits to compare.
    """
    here = job._replace(inputs={f: t.cpu() for f, t in job.inputs.items()})
    known, records = execution.forward(here, 1)
    if not all(bool(torch.isfinite(t).all()) for t in known.values()):
        return True
    seeds = {f: torch.zeros_like(t) if f == rounding else _seed(t, f.id) for f, t in known.items()}
    adjoints = execution.reverse(here, records, 1, seeds, set(here.inputs))
    found, masks = launch.forward(job)
    given = {f: t.to(job.like.device) for f, t in seeds.items()}
    others = launch.reverse(job, masks, given, set(job.inputs), CHUNK)
    eps = 1e3 * torch.finfo(job.program.dtype).eps
    states = [f for f in job.program.inputs if f.kind == Kind.STATE]
    before = dict(zip([f for f in known if f.kind == Kind.NEXT], states, strict=True))
    apart = []
    for f in known.keys() - {rounding}:
        change = known[f] - here.inputs[before[f]] if f in before else known[f]
        apart.append(_size(found[f].cpu() - known[f]) / (_size(change) + eps * _size(known[f]) + TINY))
    sizes = {f: _size(t) for f, t in here.inputs.items()}
    sizes |= {now: torch.maximum(sizes[now], _size(known[after])) for after, now in before.items()}  # what begins at 0
    effects = {f: _size(t) * sizes[f] for f, t in adjoints.items()}  # of all that there is of an input
    for f, effect in effects.items():
        error = _size(others[f].cpu() - adjoints[f]) * sizes[f]
        apart.append(error / (effect + eps * max(effects.values()) + TINY))
    return bool(torch.stack(apart).max() <= MARKS[job.program.dtype])  # not where one is NaN


def _seed(values: Tensor, number: int) -> Tensor:
    """Random, and such that components count alike, whatever their units, but for those that stay 0."""
    noise = torch.randn(values.shape, generator=torch.Generator().manual_seed(number), dtype=torch.float64)
    size = values.double().square().mean((0, 1), keepdim=True).sqrt()
    return (noise / torch.maximum(size, 1e-3 * size.amax()).clamp(min=1e-12)).to(values)


def _size(values: Tensor) -> Tensor:
    return values.double().square().mean().sqrt()
