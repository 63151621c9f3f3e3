"""Parts that only torch knows, a user's effects and materials: which they are, and their forces in every substep."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from contextlib import nullcontext

import torch
from torch import Tensor

from ..boundaries import PrescribedMotion
from ..dynamics.elasticity import MATERIAL_MEMORY_KEY, membrane_stress, update_memory
from ..dynamics.forces import effect_force, vertex_forces
from ..dynamics.kinematics import assemble, surface
from ..dynamics.model import Model, freeze_parameters
from ..effects import AbstractEffect
from ..types import ClothState, EffectInputs, Memory
from .builder import SubstepBuilder, UnsupportedPart
from .host_arrays import is_wrapped, unwrapped_numpy
from .lowering import lower


def divide(
    model: Model, state: ClothState, prescribed: Mapping[str, PrescribedMotion]
) -> tuple[SubstepBuilder, frozenset[str]]:
    """Return the program of a substep, and the names of the parts that are left to torch.

    Raises:
        UnsupportedPart: a part has no kernels and cannot be left to torch.
    """
    in_torch: set[str] = set()
    context = unwrapped_numpy() if is_wrapped(model.mass) else nullcontext()
    while True:
        try:
            with context:
                return lower(model, state, prescribed, in_torch), frozenset(in_torch)
        except UnsupportedPart as error:
            if error.part is None:
                raise
            if reason := _obstacle(model, error.part):
                raise UnsupportedPart(f"{error}, {reason},") from None
            in_torch.add(error.part)


class TorchParts:
    """The parts of a model that torch computes.

    Args:
        model: the model.
        parts: names, "material" or "effects.NAME".
    """

    def __init__(self, model: Model, parts: Collection[str]) -> None:
        effects = {name: part for name, part in model.effects.items() if f"effects.{name}" in parts}
        self.model, self.parts = model._replace(effects=effects), frozenset(parts)

    def with_frozen_parameters(self) -> TorchParts:
        """Return the same parts with the parameter values of the moment; see ``dynamics.model.freeze_parameters``."""
        return TorchParts(freeze_parameters(self.model), self.parts)

    def force(self, state: ClothState, compensation: Tensor | None, dt: float) -> tuple[Tensor, Memory]:
        """Return the force [..., V, 3] N and the internal variables of these parts at the start of a substep."""
        s = surface(self.model.geometry, state.x, state.v, compensation)
        variables = {key: value for key, value in state.memory.items() if key in self.parts}
        memory = update_memory(self.model, state._replace(memory=variables), s, dt, compensation)
        if MATERIAL_MEMORY_KEY in self.parts:
            columns = membrane_stress(self.model, s, memory)
            return vertex_forces(self.model, state, s, memory, columns, compensation), memory
        total, shares = torch.zeros_like(state.x), None
        for name, (effect, c) in self.model.effects.items():
            now = EffectInputs(
                state.x, state.v, s, self.model.mass, memory.get(f"effects.{name}"), compensation=compensation
            )
            force = effect_force(name, effect, c, now)
            if force is not None and effect.acts_on == "triangles":
                shares = force / 3 if shares is None else shares + force / 3
            elif force is not None:
                total = total + force
        if shares is not None:
            total = total + assemble(self.model.geometry, (shares, shares, shares), state.x)
        return total, memory


def _obstacle(model: Model, part: str) -> str | None:
    """Why torch cannot compute a part beside the engine; None where it can."""
    if part == MATERIAL_MEMORY_KEY:
        return None if model.grid is None else "whose directors meet other layers"
    effect = type(model.effects[part.removeprefix("effects.")][0])
    hooks = {"inertia": "adds inertia", "grip_velocities": "loosens a grasp"}
    for hook, what in (hooks | ({"viscous": "is viscous in stages"} if model.stages else {})).items():
        if getattr(effect, hook) is not getattr(AbstractEffect, hook):
            return f"which {what}"
    return None
