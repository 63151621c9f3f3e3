"""Between a cloth's tensors and those of a program: [scenes or 1, rows, components] each."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from ..boundaries import Drive
from ..dynamics.forces import Impulses
from ..types import ClothState
from .fields import Field
from .lowering import Lowering


def named(state: ClothState) -> dict[str, Tensor]:
    """What a program may carry, by the names of ``Lowering.carried``."""
    return {"x": state.x, "v": state.v, "d3": state.d3, **state.memory}


def state_inputs(low: Lowering, state: ClothState, lost: Tensor | None = None) -> dict[Field, Tensor]:
    """The state's tensors, by field; ``lost``: see ``functional.stretch``."""
    values = named(state)
    found = {carried.now: values[name] for name, carried in low.carried.items()}
    if low.lost is not None and lost is not None:
        found[low.lost.now] = lost
    return found


def drive_inputs(low: Lowering, drives: Mapping[str, Drive]) -> dict[Field, Tensor]:
    """The drives' tensors [..., substeps, comps], by field."""
    found = {}
    for name, drive in drives.items():
        increment, pose, closed = low.drives[name]
        found[increment], found[pose] = drive.increment.flatten(-2), drive.pose.flatten(-2)
        found[closed] = torch.tensor(drive.closed, dtype=low.program.dtype).unsqueeze(-1)
    return found


def flat(low: Lowering, found: Mapping[Field, Tensor], batch: torch.Size, behind: int = 2) -> dict[Field, Tensor]:
    """Contiguous tensors of the program's precision, where the cloth is.

    ``batch``: the scenes' shape, before the last ``behind`` axes.
    """
    out, scenes = {}, batch.numel()
    for field, t in found.items():
        own, rest = t.shape[:-behind], t.shape[-behind:]
        many = own.numel() > 1 or (scenes > 1 and field in _states(low))
        full = t.expand(*batch, *rest).reshape(-1, *rest) if many else t.reshape(1, *rest)
        out[field] = full.to(low.device, low.program.dtype).contiguous()
    return out


def outcome(
    low: Lowering, before: ClothState, results: Mapping[Field, Tensor], batch: torch.Size
) -> tuple[ClothState, Tensor | None, Impulses]:
    """The state after the substeps, what is lost, and the impulses, from [scenes, rows, components]."""
    shaped = {f: t.reshape(*batch, *t.shape[1:]) for f, t in results.items()}
    after = {name: shaped[carried.after] for name, carried in low.carried.items()}
    impulses = {name: shaped[f].squeeze(-2) for name, f in low.impulses.items()}
    lost = None if low.lost is None else shaped[low.lost.after].detach()  # which has no derivative
    x, v, d3 = after.pop("x"), after.pop("v"), after.pop("d3", before.d3)
    return ClothState(x, v, d3, before.memory | after), lost, impulses


def _states(low: Lowering) -> set[Field]:
    return {carried.now for carried in low.carried.values()}
