"""Conversion between a cloth's tensors and those of a program, which are [scenes or 1, rows, components]."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from ..boundaries import PrescribedMotion
from ..dynamics.forces import Impulses
from ..types import ClothState
from .builder import SubstepBuilder
from .fields import Field


def state_tensors(state: ClothState) -> dict[str, Tensor]:
    """Return all tensors of a state by the names of ``SubstepBuilder.state_fields``."""
    return {"x": state.x, "v": state.v, "d3": state.d3, **state.memory}


def state_inputs(builder: SubstepBuilder, state: ClothState, compensation: Tensor | None = None) -> dict[Field, Tensor]:
    """Return the state's tensors by field, with the compensation of the positions where there is one."""
    tensors = state_tensors(state)
    inputs = {field.start: tensors[name] for name, field in builder.state_fields.items()}
    if builder.compensation is not None and compensation is not None:
        inputs[builder.compensation.start] = compensation
    return inputs


def prescribed_inputs(builder: SubstepBuilder, prescribed: Mapping[str, PrescribedMotion]) -> dict[Field, Tensor]:
    """Return the tensors [..., substeps, comps] of prescribed motions by field."""
    inputs = {}
    for name, motion in prescribed.items():
        increment, pose, closed = builder.prescribed[name]
        inputs[increment], inputs[pose] = motion.increment.flatten(-2), motion.pose.flatten(-2)
        inputs[closed] = torch.tensor(motion.closed, dtype=builder.program.dtype).unsqueeze(-1)
    return inputs


def flatten_batch(
    builder: SubstepBuilder, tensors: Mapping[Field, Tensor], batch: torch.Size, trailing: int = 2
) -> dict[Field, Tensor]:
    """Return contiguous tensors of the program's precision, on the cloth's device, with one axis for all scenes.

    Args:
        builder: the program.
        tensors: by field.
        batch: shape of the scenes, in front of the last ``trailing`` axes.
        trailing: axes that stay.
    """
    flat, scenes = {}, batch.numel()
    states = {field.start for field in builder.state_fields.values()}
    for field, t in tensors.items():
        leading, rest = t.shape[:-trailing], t.shape[-trailing:]
        differs = leading.numel() > 1 or (scenes > 1 and field in states)
        full = t.expand(*batch, *rest).reshape(-1, *rest) if differs else t.reshape(1, *rest)
        flat[field] = full.to(builder.device, builder.program.dtype).contiguous()
    return flat


def unflatten_results(
    builder: SubstepBuilder, before: ClothState, results: Mapping[Field, Tensor], batch: torch.Size
) -> tuple[ClothState, Tensor | None, Impulses]:
    """Return the state after the substeps, the compensation, and the impulses.

    Args:
        builder: the program.
        before: the state before.
        results: [scenes, rows, components] by field.
        batch: shape of the scenes.
    """
    shaped = {f: t.reshape(*batch, *t.shape[1:]) for f, t in results.items()}
    after = {name: shaped[field.end] for name, field in builder.state_fields.items()}
    impulses = {name: shaped[f].squeeze(-2) for name, f in builder.impulses.items()}
    compensation = None
    if builder.compensation is not None:
        compensation = shaped[builder.compensation.end].detach()  # it has no derivative
    x, v, d3 = after.pop("x"), after.pop("v"), after.pop("d3", before.d3)
    return ClothState(x, v, d3, before.memory | after), compensation, impulses
