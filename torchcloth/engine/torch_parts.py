"""Parts that only torch knows, a user's effects and materials: which they are, and their forces in every substep."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from contextlib import nullcontext

import torch
from torch import Tensor

from ..boundaries import Drive
from ..dynamics.elasticity import evolve, membrane_stress
from ..dynamics.forces import force_of, vertex_forces
from ..dynamics.model import Model, as_it_is, assemble, surface
from ..effects import AbstractEffect
from ..types import ClothState, Memory, Moment
from .constants import is_wrapped, readable
from .lowering import MATERIAL, Lowering, Unfused, lower


def divide(model: Model, state: ClothState, drives: Mapping[str, Drive]) -> tuple[Lowering, frozenset[str]]:
    """The program of a substep, and the parts that are left to torch.

    Raises:
        Unfused: a part without kernels that cannot be left to torch.
    """
    in_torch: set[str] = set()
    context = readable() if is_wrapped(model.mass) else nullcontext()
    while True:
        try:
            with context:
                return lower(model, state, drives, in_torch), frozenset(in_torch)
        except Unfused as miss:
            if miss.part is None:
                raise
            if reason := _obstacle(model, miss.part):
                raise Unfused(f"{miss}, {reason},") from None
            in_torch.add(miss.part)


class TorchParts:
    """The parts of a model that torch computes, by name: "material", "effects.NAME"."""

    def __init__(self, model: Model, parts: Collection[str]) -> None:
        effects = {name: part for name, part in model.effects.items() if f"effects.{name}" in parts}
        self.model, self.parts = model._replace(effects=effects), frozenset(parts)

    def as_they_are(self) -> TorchParts:
        """See ``model.as_it_is``."""
        return TorchParts(as_it_is(self.model), self.parts)

    def force(self, state: ClothState, lost: Tensor | None, dt: float) -> tuple[Tensor, Memory]:
        """(force on the vertices [..., V, 3] N, internal variables of these parts) at the start of a substep."""
        s = surface(self.model.geometry, state.x, state.v, lost)
        own = {key: value for key, value in state.memory.items() if key in self.parts}
        memory = evolve(self.model, state._replace(memory=own), s, dt, lost)
        if MATERIAL in self.parts:
            columns = membrane_stress(self.model, s, memory)
            return vertex_forces(self.model, state, s, memory, columns, lost), memory
        total, shares = torch.zeros_like(state.x), None
        for name, (effect, c) in self.model.effects.items():
            now = Moment(state.x, state.v, s, self.model.mass, memory.get(f"effects.{name}"), lost=lost)
            force = force_of(name, effect, c, now)
            if force is not None and effect.acts_on == "triangles":
                shares = force / 3 if shares is None else shares + force / 3
            elif force is not None:
                total = total + force
        if shares is not None:
            total = total + assemble(self.model.geometry, (shares, shares, shares), state.x)
        return total, memory


def _obstacle(model: Model, part: str) -> str | None:
    """Why torch cannot compute a part beside the engine; None where it can."""
    if part == MATERIAL:
        return None if model.grid is None else "whose directors meet other layers"
    effect = type(model.effects[part.removeprefix("effects.")][0])
    hooks = {"inertia": "adds inertia", "loosen": "loosens a grasp"}
    for hook, what in (hooks | ({"viscous": "is viscous in stages"} if model.stages else {})).items():
        if getattr(effect, hook) is not getattr(AbstractEffect, hook):
            return f"which {what}"
    return None
