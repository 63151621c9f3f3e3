"""Effects and boundaries of a cloth, bound to its mesh."""

from __future__ import annotations

import copy
from collections.abc import Iterable
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary, ref

import torch
from torch import nn

from ..boundaries import AbstractBoundary
from ..effects import AbstractEffect
from ..errors import InvalidInput
from ..materials import AbstractMaterial
from ..meshes import Mesh
from .argument_checks import check_axes, check_fields, check_part


class BoundModuleDict(nn.ModuleDict):
    """Parts of a cloth by name, each bound to the cloth's mesh.

    A part that is added later is bound as well, and takes the precision and device of the others.
    """

    _like: torch.Tensor

    def __init__(self, what: str, mesh: Mesh) -> None:
        super().__init__()
        self._what, self._mesh = what, mesh
        self.register_buffer("_like", torch.zeros(0), persistent=False)

    def __setitem__(self, key: str, module: Any) -> None:
        check_part(self._what, key, module)
        check_not_bound_elsewhere(self._mesh, [(key, module)])
        if isinstance(module, AbstractEffect):
            check_fields({key: module}, len(self._mesh.faces))
            check_axes(self._mesh, {f"effects.{key}": module})
        super().__setitem__(key, module.bind(self._mesh).to(self._like))
        _OWNERS[module] = (*_owners(module), ref(self))

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore a copy, which owns its parts too if these were copied with it."""
        super().__setstate__(state)
        for part in self.values():
            if not _owners(part):
                _OWNERS[part] = (ref(self),)


def check_not_bound_elsewhere(mesh: Mesh, parts: Iterable[tuple[str, AbstractEffect | AbstractBoundary]]) -> None:
    """Refuse parts that are bound to the mesh of another cloth, which binding them anew would break.

    Raises:
        InvalidInput: a part of a cloth with another mesh.
    """
    for name, part in parts:
        if any((owner := reference()) is not None and not owner._mesh.is_equal(mesh) for reference in _owners(part)):
            raise InvalidInput(
                name,
                got="an effect or boundary of another cloth, bound to its mesh",
                expected="one of its own",
                remedy="make it anew, or copy.deepcopy it",
            )


class UnboundParts(NamedTuple):
    """Copies of a cloth's parts that no cloth owns yet."""

    material: AbstractMaterial
    areal_density: torch.Tensor
    effects: dict[str, AbstractEffect]
    boundaries: dict[str, AbstractBoundary]


def copy_parts(cloth: Any) -> UnboundParts:
    """Copy the parts of a cloth, to build another cloth from them on any mesh.

    Modules that several parts share are shared by their copies too.
    """
    memo = {id(cloth.mesh): cloth.mesh}
    effects, boundaries = (
        {name: copy.deepcopy(part, memo) for name, part in parts.items()} for parts in (cloth.effects, cloth.boundaries)
    )
    density = cloth.areal_density.value.detach().clone()
    return UnboundParts(copy.deepcopy(cloth.material, memo), density, effects, boundaries)


def _owners(part: nn.Module) -> tuple[ref[BoundModuleDict], ...]:
    return tuple(owner for owner in _OWNERS.get(part, ()) if owner() is not None)


_OWNERS: WeakKeyDictionary[nn.Module, tuple[ref[BoundModuleDict], ...]] = WeakKeyDictionary()
