"""The algorithm on one page. Read this file first.

One substep: internal variables -> forces on the mesh, stiff viscous ones in stages -> velocities -> contact through the
grid -> boundaries -> positions -> directors. Elasticity and effects act on the vertices, which carry all the mass; the
grid carries only contact. That split is what makes the solution converge when the step is halved: forces that pass
through the grid are filtered at every step.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from .._utils.linalg import dot, resisted
from ..boundaries import Drive
from ..types import ClothState
from .contact.self_contact import Layers, add_columns, director_energy, follow, near_layers, pressure, repulsion
from .elasticity import elastic, evolve, membrane_stress
from .forces import Impulses, added, constrain, resistance_of, vertex_forces
from .model import Geometry, Model, surface
from .viscous_stages import relaxed

__all__ = ["Geometry", "Impulses", "Model", "energy", "rollout", "step", "surface"]


def step(
    model: Model,
    state: ClothState,
    dt: float,
    drives: Mapping[str, Drive],
    substep: int,
    layers: Layers | None = None,
    compensation: Tensor | None = None,
) -> tuple[ClothState, Impulses]:
    """Advance one substep (symplectic Euler).

    ``layers``: of this state or one nearby, None: to be found. ``lost``: see ``stretch``.
    """
    s = surface(model.geometry, state.x, state.v, compensation)
    memory = evolve(model, state, s, dt, compensation)
    columns = membrane_stress(model, s, memory)
    grid, press = model.grid, None
    if grid is not None:
        layers = near_layers(model, grid, state.x) if layers is None else layers
        if len(layers.active):
            press = pressure(model, grid, layers, state, s, dt)
            columns = add_columns(layers, columns, press)

    resistance = resistance_of(model, s, state.x)
    force = vertex_forces(model, state, s, memory, columns, compensation)
    v = relaxed(model, state, s, memory, dt, drives, substep, resistance)
    free = v + dt * resisted(resistance, force / model.mass)
    if grid is not None and layers is not None and press is not None:
        free = free + resisted(resistance, repulsion(model, grid, layers, press, s, free, dt))
    v, impulses = constrain(model, state.x, free, dt, drives, substep, resistance)

    x, d3 = state.x + dt * v, state.d3
    if grid is not None and layers is not None:
        d3, memory["contact"] = follow(model, grid, layers, press, s, v, surface(model.geometry, x, v), dt)
    return ClothState(x, v, d3, memory), impulses


def rollout(model: Model, state: ClothState, dt: float, drives: Mapping[str, Drive], substeps: int, first: int = 0):
    """``substeps`` substeps from index ``first`` of the drives; impulses are summed."""
    state, _, total = stretch(model, state, None, dt, drives, substeps, first)
    return state, total


def stretch(
    model: Model,
    state: ClothState,
    lost: Tensor | None,
    dt: float,
    drives: Mapping[str, Drive],
    substeps: int,
    first: int = 0,
) -> tuple[ClothState, Tensor | None, Impulses]:
    """As ``rollout``; ``lost`` goes from one stretch to the next: see ``_kept``."""
    total: Impulses = {}
    layers = None
    for k in range(first, first + substeps):
        if model.grid is not None:
            layers = near_layers(model, model.grid, state.x, layers)
        state, lost, impulses = substep(model, state, lost, dt, drives, k, layers)
        total = added(total, impulses)
    return state, lost, total


def substep(
    model: Model,
    state: ClothState,
    lost: Tensor | None,
    dt: float,
    drives: Mapping[str, Drive],
    k: int,
    layers: Layers | None,
) -> tuple[ClothState, Tensor | None, Impulses]:
    """As ``step``, or the model's custom substep, with what the substep before has ``lost``."""
    before, advance = state.x, step if model.custom_substep is None else model.custom_substep.advance
    state, impulses = advance(model, state, dt, drives, k, layers, lost)
    if state.x.dtype == torch.float32:
        state, lost = _kept(before, state, lost, dt)
    return state, lost, impulses


def _kept(before: Tensor, state: ClothState, lost: Tensor | None, dt: float) -> tuple[ClothState, Tensor]:
    """Add to the positions what was too small to be added before; what is too small now (Kahan 1965).

    Substeps are short: at 1 mm/s they are one or two units in the last place of float32, and what is rounded alike in
    all of them would let slow grippers move cloth twice as far, or not at all.
    """
    missing = (dt * state.v - (state.x - before)).detach()
    missing = missing if lost is None else lost + missing
    x = state.x + missing
    return state._replace(x=x), missing - (x - state.x).detach()


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
