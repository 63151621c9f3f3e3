"""What a substep needs: the mesh's constants, the parts, and the kinematics of the triangles."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import copy
from typing import Any, NamedTuple, TypeVar, cast

import torch
from torch import Tensor, nn

from .._utils.linalg import cross, dot
from ..boundaries import AbstractBoundary
from ..effects import AbstractEffect
from ..materials import AbstractMaterial
from ..types import ClothState, Surface
from .contact import Grid

ModuleT = TypeVar("ModuleT", bound=nn.Module)


class Geometry(NamedTuple):
    """Constants of the mesh, in the layout that the substep reads."""

    corners: Tensor  # [3 E] int64, first all first corners, then all second, then all third
    warp: tuple[Tensor, Tensor]  # each [E, 1] 1/m: f1 = warp[0] d1 + warp[1] d2 with edges d1 = x1 - x0, d2 = x2 - x0
    weft: tuple[Tensor, Tensor]  # likewise f2
    area: Tensor  # [E, 1] m^2, rest

    @classmethod
    def of(cls, corners: Tensor, gradient: Tensor, area: Tensor) -> Geometry:
        """From the gradients of the shape functions [E, 3, 2] 1/m."""
        g = gradient
        return cls(corners, (g[:, 1, 0:1], g[:, 2, 0:1]), (g[:, 1, 1:2], g[:, 2, 1:2]), area)


class CustomSubstep(NamedTuple):
    """A substep that replaces ``dynamics.substep.step``. It compares schemes; the fused engine does not know it.

    Attributes:
        name: the scheme's, for messages.
        advance: takes and returns what ``dynamics.substep.step`` does.
        initial_memory: returns the scheme's internal variables by name, for vertex positions [..., V, 3] m and the
            number of triangles. They are kept in ``ClothState.memory``.
    """

    name: str
    advance: Callable[..., tuple[ClothState, dict[str, Tensor]]]
    initial_memory: Callable[[Tensor, int], dict[str, Tensor]]


class Model(NamedTuple):
    """Everything a substep needs, with all parameters resolved to tensors."""

    geometry: Geometry
    mass: Tensor  # [..., V, 1] kg
    areal_density: Tensor  # [..., 1 or E, 1] kg/m^2
    material: AbstractMaterial
    coefficients: Any
    effects: Mapping[str, tuple[AbstractEffect, Any]]
    boundaries: Mapping[str, AbstractBoundary]
    grid: Grid | None = None  # of the contact between layers; None without contact
    custom_substep: CustomSubstep | None = None  # None: the substep of dynamics/substep.py
    rest: Tensor | None = None  # [..., E or 1, 4]: F_E = F A for a rest shape that differs from the pattern
    stages: int = 0  # in which viscous forces act, see relaxation.py; 0: with all other forces


def as_it_is(model: Model) -> Model:
    """With parts that keep the values of the moment, for a backward pass that computes again.

    Parameters of ``functional_call`` have gone by then, and an optimiser may have written to others.
    """
    names = ("material", "coefficients", "effects", "boundaries", "mass", "areal_density", "rest")
    return model._replace(**{name: mapped(getattr(model, name), torch.clone) for name in names})


def mapped(tree: Any, change: Callable[[Tensor], Tensor], buffers: bool = False) -> Any:
    """The same with every tensor changed, and every parameter of a module; buffers, too, or the same ones.

    Looked into are modules, mappings, tuples and lists.
    """
    if isinstance(tree, Tensor):
        return change(tree)
    if isinstance(tree, nn.Module):
        own = kept(tree)
        for inner in own.modules():
            changed = {n: None if p is None else change(p) for n, p in inner._parameters.items()}
            inner._parameters = cast("dict[str, nn.Parameter | None]", changed)
            if buffers:
                inner._buffers = {n: None if b is None else change(b) for n, b in inner._buffers.items()}
        return own
    if isinstance(tree, Mapping):
        return {name: mapped(part, change, buffers) for name, part in tree.items()}
    if isinstance(tree, tuple | list):
        parts = [mapped(part, change, buffers) for part in tree]
        return type(tree)(*parts) if hasattr(tree, "_fields") else type(tree)(parts)
    return tree


def kept(part: ModuleT) -> ModuleT:
    """A part that keeps the parameters and buffers of the moment, and shares all else."""
    own = copy(part)
    own.__dict__ = part.__dict__.copy()
    own._parameters, own._buffers = part._parameters.copy(), part._buffers.copy()
    own._modules = {name: None if inner is None else kept(inner) for name, inner in part._modules.items()}
    return own


def vertex_mass(geometry: Geometry, density: Tensor, share: Tensor) -> Tensor:
    """Lumped masses [..., V, 1] kg, from kg/m^2 [...] or [..., E] and the vertices' areas ``share`` [V, 1]."""
    if density.ndim == 0:
        return density * share
    triangle = density.unsqueeze(-1) * geometry.area / 3
    corners = torch.cat([triangle] * 3, dim=-2)
    return triangle.new_zeros(*triangle.shape[:-2], *share.shape).index_add(-2, geometry.corners, corners)


def surface(geometry: Geometry, x: Tensor, v: Tensor, lost: Tensor | None = None) -> Surface:
    """Kinematics of the triangles from vertex positions and velocities [..., V, 3].

    ``lost``: what of the positions was too small to be added to them, see ``functional.stretch``. Rounded alone, edges
    at 1 m from the origin would strain by 1e-6 in float32, and stiff cloth would creep on a table.
    """
    x0, x1, x2 = corners(geometry, x)
    d1, d2 = x1 - x0, x2 - x0
    if lost is not None:
        l0, l1, l2 = corners(geometry, lost)
        d1, d2 = d1 + (l1 - l0), d2 + (l2 - l0)
    f1 = geometry.warp[0] * d1 + geometry.warp[1] * d2
    f2 = geometry.weft[0] * d1 + geometry.weft[1] * d2
    normal = cross(f1, f2)
    J = dot(normal, normal).sqrt()
    n = normal / J
    return Surface(f1, f2, cross(f2, n), cross(n, f1), n, J, geometry.area, centroids(geometry, v))


def corners(geometry: Geometry, field: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Values [..., E, K] at the triangles' three corners."""
    return field.index_select(-2, geometry.corners).unflatten(-2, (3, -1)).unbind(-3)  # type: ignore[return-value]


def centroids(geometry: Geometry, field: Tensor) -> Tensor:
    """Mean [..., E, K] of the values at the triangles' corners."""
    a, b, c = corners(geometry, field)
    return (a + b + c) / 3


def assemble(geometry: Geometry, shares: tuple[Tensor, Tensor, Tensor], like: Tensor) -> Tensor:
    """Sum the corners' shares [..., E, K] on the vertices [..., V, K]; ``like`` has the result's shape.

    Either may lack batch dimensions that the other has.
    """
    stacked = torch.cat(shares, dim=-2)
    stacked = stacked.expand(*torch.broadcast_shapes(stacked.shape[:-2], like.shape[:-2]), *stacked.shape[-2:])
    index = geometry.corners.unsqueeze(-1).expand(stacked.shape)  # scatter_add: 7 times faster than index_add here
    return torch.zeros_like(like).expand(*stacked.shape[:-2], -1, -1).scatter_add(-2, index, stacked)
