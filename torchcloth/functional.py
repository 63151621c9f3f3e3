"""The algorithm on one page. Read this file first.

One substep:  internal variables -> forces on the mesh -> velocities -> contact through the grid -> boundaries ->
positions -> directors. Elasticity and effects act on the vertices, which carry all the mass; the grid carries only
contact. That split is what makes the solution converge when the step is halved: forces that pass through the grid
are filtered at every step.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import cast

import torch
from torch import Tensor

from ._math import cross, dot
from .boundaries import Drive
from .model import Geometry, Model, assemble, surface
from .self_contact import Layers, add_columns, director_energy, follow, near_layers, pressure, repulsion
from .strain import elastic, evolve, membrane_stress
from .types import ClothState, Memory, Moment, Surface

__all__ = ["Geometry", "Model", "energy", "rollout", "step", "surface"]

Impulses = dict[str, Tensor]  # name of a driven boundary -> [..., 6] N s, N m s: what it gave the cloth


def step(
    model: Model, state: ClothState, dt: float, drives: Mapping[str, Drive], substep: int, layers: Layers | None = None
) -> tuple[ClothState, Impulses]:
    """Advance one substep (symplectic Euler); ``layers`` may be those of a nearby state."""
    s = surface(model.geometry, state.x, state.v)
    memory = evolve(model, state, s, dt)
    columns = membrane_stress(model, s, memory)
    grid, press = model.grid, None
    if grid is not None:
        layers = near_layers(model, grid, state.x, layers)
        if len(layers.active):
            press = pressure(model, grid, layers, state, s)
            columns = add_columns(layers, columns, press)

    resistance = _resistance(model, s, state.x)
    force = _vertex_forces(model, state, s, memory, columns)
    free = state.v + dt * _resisted(resistance, force / model.mass)
    if grid is not None and layers is not None and press is not None:
        free = free + _resisted(resistance, repulsion(model, grid, layers, press, free, dt))
    v, impulses = _constrain(model, state.x, free, dt, drives, substep, resistance)

    x, d3 = state.x + dt * v, state.d3
    if grid is not None and layers is not None:
        d3, memory["contact"] = follow(model, grid, layers, press, s, v, surface(model.geometry, x, v), dt)
    return ClothState(x, v, d3, memory), impulses


def rollout(model: Model, state: ClothState, dt: float, drives: Mapping[str, Drive], substeps: int, first: int = 0):
    """``substeps`` substeps from index ``first`` of the drives; impulses are summed."""
    total: Impulses = {}
    layers = None
    for k in range(first, first + substeps):
        if model.grid is not None:
            layers = near_layers(model, model.grid, state.x, layers)
        state, impulses = step(model, state, dt, drives, k, layers)
        total = {name: total[name] + value if name in total else value for name, value in impulses.items()}
    return state, total


def energy(model: Model, state: ClothState) -> dict[str, Tensor]:
    """Energies [...] J: kinetic, membrane, director."""
    s = surface(model.geometry, state.x, state.v)
    strained, share = elastic(model, s, state.memory)
    density = model.material.membrane_energy(model.coefficients, strained)
    out = {
        "kinetic": 0.5 * (model.mass * dot(state.v, state.v)).sum((-2, -1)),
        "membrane": (s.area * (density if share is None else share * density)).sum((-2, -1)),
    }
    if model.grid is not None:
        out["director"] = director_energy(model, model.grid, s, state.d3)
    return out


def _vertex_forces(
    model: Model, state: ClothState, s: Surface, memory: Memory, columns: tuple[Tensor, Tensor]
) -> Tensor:
    """Internal forces and effects, assembled on the vertices [..., V, 3] N."""
    g = model.geometry
    p1, p2 = columns
    second = -g.area * (g.warp[0] * p1 + g.weft[0] * p2)
    third = -g.area * (g.warp[1] * p1 + g.weft[1] * p2)
    first = -(second + third)
    direct = None
    for name, (effect, c) in model.effects.items():
        force = effect.force(c, Moment(state.x, state.v, s, model.mass, memory.get(f"effects.{name}")))
        if force is None:
            continue
        if effect.acts_on == "triangles":
            part = force / 3
            first, second, third = first + part, second + part, third + part
        else:
            direct = force if direct is None else direct + force
    total = assemble(g, (first, second, third), state.x)
    return total if direct is None else total + direct


def _resistance(model: Model, s: Surface, x: Tensor) -> Tensor | None:
    """Mass that moves along with the normal only, relative to the vertices' own [..., V, 3, 3]; None without any."""
    found = [effect.inertia(c, s) for effect, c in model.effects.values()]
    triangles = [m for m in found if m is not None]
    if not triangles:
        return None
    share = (sum(triangles) / 3 * s.n).unsqueeze(-1) * s.n.unsqueeze(-2)
    flat = share.flatten(-2)
    total = assemble(model.geometry, (flat, flat, flat), x[..., :1].expand(*x.shape[:-1], 9))
    return (total / model.mass).unflatten(-1, (3, 3))


def _resisted(resistance: Tensor | None, change: Tensor) -> Tensor:
    """(1 + B)^-1 y, written so that B = 0 changes nothing, bitwise."""
    if resistance is None:
        return change
    excess = (resistance @ change.unsqueeze(-1)).squeeze(-1)
    return change - torch.linalg.solve(torch.eye(3).to(change) + resistance, excess)


def _loaded(resistance: Tensor | None, change: Tensor) -> Tensor:
    """(1 + B) y: what a gripper gives the cloth and the air that moves along."""
    return change if resistance is None else change + (resistance @ change.unsqueeze(-1)).squeeze(-1)


def _constrain(
    model: Model,
    x: Tensor,
    v: Tensor,
    dt: float,
    drives: Mapping[str, Drive],
    substep: int,
    resistance: Tensor | None,
):
    """Velocities that obey the boundaries, and what each driven one gave: impulse and its moment about the body."""
    impulses: Impulses = {}
    for name, boundary in model.boundaries.items():
        drive = drives.get(name)
        after = boundary.apply(x, v, dt, drive, substep)
        if drive is not None:
            after = _slipped(model, name, v, after, dt)
            momentum = model.mass * _loaded(resistance, after - v)
            arm = x - _origin(drive, substep)
            impulses[name] = torch.cat([momentum.sum(-2), cross(arm, momentum).sum(-2)], dim=-1)
        v = after
    return v, impulses


def _origin(drive: Drive, substep: int) -> Tensor:
    """Where the body's origin is at the start of the substep [..., 1, 3] m; with x there, angular momentum balances."""
    step, end = drive.increment[..., substep, :, :], drive.pose[..., substep, None, :3, 3]
    return (end - step[..., None, :3, 3]) @ step[..., :3, :3]


def _slipped(model: Model, grasp: str, free: Tensor, held: Tensor, dt: float) -> Tensor:
    for effect, c in model.effects.values():
        if effect.grasp == grasp:
            index = cast("Tensor", model.boundaries[grasp].index)
            held = effect.loosen(c, index, free, held, model.mass, dt)
    return held
