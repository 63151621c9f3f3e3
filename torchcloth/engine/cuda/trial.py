"""A device is believed after it did what the processor does: some substeps, and their adjoint."""

from __future__ import annotations

import torch
from torch import Tensor

from .. import running
from ..building import Unbuilt
from ..fields import Field, Kind
from ..running import Job
from . import runs

MARKS = {torch.float64: 1e-6, torch.float32: 0.05}  # of the root mean squares; what goes wrong there is of order 1
TINY = 1e-300


def check(job: Job, rounding: Field | None) -> None:
    """Run a job on its device and here.

    ``rounding``: the result that holds what was lost in it, which has no digits to compare.

    Raises:
        Unbuilt: the results, or the adjoints of a random function of them, are others.
    """
    here = job._replace(inputs={f: t.cpu() for f, t in job.inputs.items()})
    known, records = running.forward(here, 1)
    if not all(bool(torch.isfinite(t).all()) for t in known.values()):
        return  # a cloth that nobody can simulate, of which it will be told
    seeds = {f: torch.zeros_like(t) if f == rounding else _seed(t, f.id) for f, t in known.items()}
    adjoints = running.reverse(here, records, 1, seeds, set(here.inputs))
    device = job.like.device
    found, masks = runs.forward(job)
    others = runs.reverse(job, masks, {f: t.to(device) for f, t in seeds.items()}, set(job.inputs))
    eps = 1e3 * torch.finfo(job.program.dtype).eps
    states = [f for f in job.program.inputs if f.kind == Kind.STATE]
    before = dict(zip([f for f in known if f.kind == Kind.NEXT], states, strict=True))
    apart = []
    for f in known.keys() - {rounding}:
        change = known[f] - here.inputs[before[f]] if f in before else known[f]
        apart.append(_size(found[f].cpu() - known[f]) / (_size(change) + eps * _size(known[f]) + TINY))
    effects = {f: _size(t) * _size(here.inputs[f]) for f, t in adjoints.items()}  # of all that there is of an input
    for f, effect in effects.items():
        error = _size(others[f].cpu() - adjoints[f]) * _size(here.inputs[f])
        apart.append(error / (effect + eps * max(effects.values()) + TINY))
    worst = torch.stack(apart).max()  # NaN if there is one
    if not worst <= MARKS[job.program.dtype]:
        name = torch.cuda.get_device_name(device) if device.type == "cuda" else str(device)
        raise Unbuilt(f"the engine on {name} is not the CPU's, {float(worst):.1g} apart", "please report it")


def _seed(values: Tensor, number: int) -> Tensor:
    """Random, and such that all components count alike, whatever their units."""
    noise = torch.randn(values.shape, generator=torch.Generator().manual_seed(number), dtype=torch.float64)
    size = values.double().square().mean(1, keepdim=True).sqrt()
    return (noise / size.clamp(min=1e-12)).to(values)


def _size(values: Tensor) -> Tensor:
    return values.double().square().mean().sqrt()
