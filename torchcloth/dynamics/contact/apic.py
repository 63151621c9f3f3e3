"""The usual scheme, kept for comparison: all forces pass through the grid (APIC; Jiang, Gast, Teran 2017).

Vertices and triangles are particles; a quarter of a triangle's mass goes to each corner and to itself. The transfer
filters velocities at every substep, so its damping depends on dt: docs/verification.md shows both schemes side by side.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import cast

import torch
from torch import Tensor

from ...boundaries import Drive
from ...types import ClothState, Surface
from ..elasticity import evolve, membrane_stress
from ..forces import Impulses, constrain, vertex_forces
from ..model import Model, centroids, surface
from . import Grid, carried_momentum, lattice, stencil, through
from .self_contact import Layers, add_columns, near_layers, per_point, pressure


def step(
    model: Model,
    state: ClothState,
    dt: float,
    drives: Mapping[str, Drive],
    substep: int,
    layers: Layers | None = None,
    lost: Tensor | None = None,
) -> tuple[ClothState, Impulses]:
    """As ``functional.step``; ``memory["apic"]`` [..., V + E, 9] 1/s is the affine velocity of the particles."""
    grid = cast("Grid", model.grid)  # Cloth refuses to be made without
    s = surface(model.geometry, state.x, state.v, lost)
    memory = evolve(model, state, s, dt, lost)
    layers = near_layers(model, grid, state.x) if layers is None else layers
    press = pressure(model, grid, layers, state, s, dt)
    columns = add_columns(layers, membrane_stress(model, s, memory), press)
    nothing = (torch.zeros_like(columns[0]), torch.zeros_like(columns[1]))
    # Weight, air: triangles get their share of it as well. Of air that moves along, nothing.
    light = {name: (effect, c) for name, (effect, c) in model.effects.items() if effect.inertia(c, s) is None}
    airless = model._replace(effects=light)
    outer = vertex_forces(airless, state, s, memory, nothing, lost)
    force = vertex_forces(airless, state, s, memory, columns, lost) - outer
    v = state.v + dt * outer / model.mass

    batch, vertices = state.x.shape[:-2], state.x.shape[-2]
    position, velocity = (
        torch.cat([field, centroids(model.geometry, field)], dim=-2).reshape(-1, 3) for field in (state.x, v)
    )
    mass = _masses(model, state, s).reshape(-1, 1)
    each = position.shape[0] // max(1, batch.numel())
    scene = torch.arange(batch.numel(), device=position.device).repeat_interleave(each)
    nodes = stencil(position, mass, scene, grid, layers.slots)

    affine = memory["apic"].reshape(-1, 3, 3)
    momentum = carried_momentum(nodes, mass, velocity, affine, grid.spacing)
    slope = nodes.slope.unflatten(0, (-1, each))[:, vertices:].flatten(0, 1)
    director = -(slope @ press.d3.unsqueeze(-1)) * press.pull.unsqueeze(-2)
    weight = nodes.weight.unflatten(0, (-1, each))[:, :vertices].flatten(0, 1)
    mesh = weight.unsqueeze(-1) * force.reshape(-1, 1, 3)
    both = torch.cat([part.unflatten(0, (batch.numel(), -1)) for part in (mesh, director)], dim=1).flatten(0, 1)
    seen = through(nodes.node, momentum + dt * both) * nodes.inverse.unsqueeze(-1)

    arm = (lattice(position) - nodes.offset.unsqueeze(-2)) * grid.spacing
    weighted = nodes.weight.unsqueeze(-1) * seen
    memory["apic"] = (4 / grid.spacing**2 * weighted.mT @ arm).view(*batch, each, 9)
    free = weighted.sum(-2).view(*batch, each, 3)[..., :vertices, :]
    v, impulses = constrain(model, state.x, free, dt, drives, substep, None)
    x = state.x + dt * v

    gradient = (seen.mT @ nodes.slope).unflatten(0, (-1, each))[:, vertices:].flatten(0, 1)
    moved = press.d3 + dt * (gradient @ press.d3.unsqueeze(-1)).squeeze(-1)
    n = surface(model.geometry, x, v).n.reshape(-1, 1, 3)
    mapped = model.material.return_map(per_point(model, layers, s), n, moved.unsqueeze(-2))
    return ClothState(x, v, mapped.view(state.d3.shape), memory), impulses


def _masses(model: Model, state: ClothState, s: Surface) -> Tensor:
    """[..., V + E, 1] kg; what triangles carry is not the vertices', what effects add is."""
    triangle = (model.areal_density * s.area / 4).expand(*s.n.shape[:-1], 1)
    vertex = model.mass.expand(*state.x.shape[:-1], 1)
    corners = torch.cat([triangle / 3] * 3, dim=-2)
    return torch.cat([vertex.index_add(-2, model.geometry.corners, corners, alpha=-1), triangle], dim=-2)
