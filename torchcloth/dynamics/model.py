"""The model that a substep advances: mesh constants, the parts of the cloth, and their parameters as tensors."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import copy
from typing import Any, NamedTuple, TypeVar, cast

import torch
from torch import Tensor, nn

from ..boundaries import AbstractBoundary
from ..effects import AbstractEffect
from ..materials import AbstractMaterial
from ..types import ClothState
from .contact import Grid
from .kinematics import Geometry

ModuleT = TypeVar("ModuleT", bound=nn.Module)


class CustomSubstep(NamedTuple):
    """A substep that replaces ``dynamics.substep.step``. It compares schemes; the fused engine does not know it.

    Attributes:
        name: the scheme's name, for messages.
        advance: takes and returns what ``dynamics.substep.step`` does.
        initial_memory: returns the scheme's internal variables by name, for vertex positions [..., V, 3] m and the
            number of triangles. They are stored in ``ClothState.memory``.
    """

    name: str
    advance: Callable[..., tuple[ClothState, dict[str, Tensor]]]
    initial_memory: Callable[[Tensor, int], dict[str, Tensor]]


class Model(NamedTuple):
    """Everything a substep needs, with all parameters resolved to tensors.

    Attributes:
        geometry: mesh constants.
        mass: [..., V, 1] kg, vertex masses with what effects add.
        areal_density: [..., 1 or E, 1] kg/m^2, of the fabric alone.
        material: the constitutive law.
        coefficients: what ``material.coefficients()`` returned.
        effects: name -> (effect, what its ``coefficients()`` returned).
        boundaries: grasps and colliders by name, in the order in which they are applied.
        grid: discretisation of contact between layers; None without contact.
        custom_substep: scheme that replaces the one of ``dynamics/substep.py``; None: no replacement.
        inverse_rest_deformation: [..., E or 1, 4], A of F_E = F A by rows, for a rest shape that differs from the
            pattern; None: the pattern is the rest shape.
        stages: number of stages in which stiff viscous forces act (``viscous_stages``); 0: with all other forces.
    """

    geometry: Geometry
    mass: Tensor
    areal_density: Tensor
    material: AbstractMaterial
    coefficients: Any
    effects: Mapping[str, tuple[AbstractEffect, Any]]
    boundaries: Mapping[str, AbstractBoundary]
    grid: Grid | None = None
    custom_substep: CustomSubstep | None = None
    inverse_rest_deformation: Tensor | None = None
    stages: int = 0


def freeze_parameters(model: Model) -> Model:
    """Return a copy of the model whose tensors keep their present values, for a backward pass that recomputes.

    By then ``functional_call`` has taken its parameters away, and an optimiser may have written to the others.
    """
    names = ("material", "coefficients", "effects", "boundaries", "mass", "areal_density", "inverse_rest_deformation")
    return model._replace(**{name: tree_map(getattr(model, name), torch.clone) for name in names})


def tree_map(tree: Any, function: Callable[[Tensor], Tensor], buffers: bool = False) -> Any:
    """Apply ``function`` to every tensor in nested modules, mappings, tuples and lists, and return the new tree.

    Of a module, parameters are mapped, and buffers if ``buffers`` is set; otherwise the copy shares its buffers.
    """
    if isinstance(tree, Tensor):
        return function(tree)
    if isinstance(tree, nn.Module):
        clone = shallow_clone_module(tree)
        for module in clone.modules():
            parameters = {n: None if p is None else function(p) for n, p in module._parameters.items()}
            module._parameters = cast("dict[str, nn.Parameter | None]", parameters)
            if buffers:
                module._buffers = {n: None if b is None else function(b) for n, b in module._buffers.items()}
        return clone
    if isinstance(tree, Mapping):
        return {name: tree_map(part, function, buffers) for name, part in tree.items()}
    if isinstance(tree, tuple | list):
        parts = [tree_map(part, function, buffers) for part in tree]
        return type(tree)(*parts) if hasattr(tree, "_fields") else type(tree)(parts)
    return tree


def shallow_clone_module(module: ModuleT) -> ModuleT:
    """Return a copy of a module that keeps its present parameters and buffers and shares everything else."""
    clone = copy(module)
    clone.__dict__ = module.__dict__.copy()
    clone._parameters, clone._buffers = module._parameters.copy(), module._buffers.copy()
    clone._modules = {
        name: None if child is None else shallow_clone_module(child) for name, child in module._modules.items()
    }
    return clone
