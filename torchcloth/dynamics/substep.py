"""The algorithm on one page. Read this file first.

``step`` advances the cloth by one substep, in this order:

1. kinematics of the triangles (``kinematics.surface``);
2. internal variables: plastic set, internal friction, creases (``elasticity.update_memory``);
3. membrane stress (``elasticity.membrane_stress``), and the reaction of the directors of triangles near another layer
   (``contact.self_contact.find_contact_candidates``, ``compute_director_forces``);
4. mass of the air that moves along (``forces.compute_added_mass_ratio``);
5. forces f on the vertices, without the stiff viscous ones (``forces.vertex_forces``);
6. stiff viscous forces on the old velocities, in stages (``viscous_stages.apply_viscous_stages``);
7. free velocities, as if there were neither contact nor boundaries: those of 6 plus dt f over the mass of cloth and
   air. So 5 and 6 act in parallel, both from the state at the start of the substep;
8. contact between layers, which changes these velocities through the grid
   (``contact.self_contact.contact_velocity_change``);
9. boundaries: grasps and colliders, in order (``forces.apply_boundaries``);
10. positions x + dt v, and the directors that they carry along (``contact.self_contact.advance_directors``).

In float32 ``compensated_step`` also carries the rounding errors of the positions on. A director is a vector at each
contact point that starts as the surface normal and is compressed where layers press on each other.

Elasticity and effects act on the vertices, which carry all the mass; the grid carries only contact. That split makes
the solution converge when the step is halved: forces that pass through the grid are filtered at every step.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from .._utils.linalg import dot, solve_added_mass
from ..boundaries import PrescribedMotion
from ..types import ClothState
from .contact.self_contact import (
    ContactCandidates,
    add_director_stress,
    advance_directors,
    compute_director_forces,
    contact_velocity_change,
    director_energy,
    find_contact_candidates,
)
from .elasticity import elastic_deformation, membrane_stress, update_memory
from .forces import Impulses, add_impulses, apply_boundaries, compute_added_mass_ratio, vertex_forces
from .kinematics import surface
from .model import Model
from .viscous_stages import apply_viscous_stages


def step(
    model: Model,
    state: ClothState,
    dt: float,
    prescribed: Mapping[str, PrescribedMotion],
    substep: int,
    contact_candidates: ContactCandidates | None = None,
    compensation: Tensor | None = None,
) -> tuple[ClothState, Impulses]:
    """Advance the cloth by one substep of symplectic Euler.

    Args:
        model: mesh constants and parts, with all parameters resolved to tensors.
        state: positions, velocities and internal variables at the start of the substep.
        dt: length of the substep [s].
        prescribed: motion of the driven boundaries by name, one row per substep.
        substep: row of ``prescribed`` to use.
        contact_candidates: triangles that may touch another layer, from this or a nearby state; searched for if None.
        compensation: [..., V, 3] m, rounding error of ``state.x`` that is carried over (Kahan summation, float32 only).

    Returns:
        The state at the end of the substep, and the impulse [N s, N m s] that each driven boundary gave the cloth.
    """
    s = surface(model.geometry, state.x, state.v, compensation)
    memory = update_memory(model, state, s, dt, compensation)
    stress = membrane_stress(model, s, memory)
    grid, directors = model.grid, None
    if grid is not None:
        if contact_candidates is None:
            contact_candidates = find_contact_candidates(model, grid, state.x)
        if len(contact_candidates.active):
            directors = compute_director_forces(model, grid, contact_candidates, state, s, dt, substep)
            stress = add_director_stress(contact_candidates, stress, directors)

    added_mass_ratio = compute_added_mass_ratio(model, s, state.x)
    force = vertex_forces(model, state, s, memory, stress, compensation)
    v = apply_viscous_stages(model, state, s, memory, dt, prescribed, substep, added_mass_ratio)
    free_v = v + dt * solve_added_mass(added_mass_ratio, force / model.mass)  # without contact and boundaries
    if grid is not None and contact_candidates is not None and directors is not None:
        change = contact_velocity_change(model, grid, contact_candidates, directors, s, free_v, dt)
        free_v = free_v + solve_added_mass(added_mass_ratio, change)
    v, impulses = apply_boundaries(model, state.x, free_v, dt, prescribed, substep, added_mass_ratio)

    x, d3 = state.x + dt * v, state.d3
    if grid is not None and contact_candidates is not None:
        after = surface(model.geometry, x, v)
        d3, memory["contact"] = advance_directors(model, grid, contact_candidates, directors, s, v, after, dt)
    return ClothState(x, v, d3, memory), impulses


def rollout(
    model: Model,
    state: ClothState,
    dt: float,
    prescribed: Mapping[str, PrescribedMotion],
    substeps: int,
    first: int = 0,
) -> tuple[ClothState, Impulses]:
    """Advance the cloth by ``substeps`` substeps, from row ``first`` of the prescribed motion on.

    Returns:
        The last state, and the impulses summed over all substeps.
    """
    state, _, total = rollout_segment(model, state, None, dt, prescribed, substeps, first)
    return state, total


def rollout_segment(
    model: Model,
    state: ClothState,
    compensation: Tensor | None,
    dt: float,
    prescribed: Mapping[str, PrescribedMotion],
    substeps: int,
    first: int = 0,
) -> tuple[ClothState, Tensor | None, Impulses]:
    """Advance as ``rollout`` does, with the rounding error that passes from one segment to the next."""
    total: Impulses = {}
    candidates = None
    for k in range(first, first + substeps):
        if model.grid is not None:
            candidates = find_contact_candidates(model, model.grid, state.x, candidates)
        state, compensation, impulses = compensated_step(model, state, compensation, dt, prescribed, k, candidates)
        total = add_impulses(total, impulses)
    return state, compensation, total


def compensated_step(
    model: Model,
    state: ClothState,
    compensation: Tensor | None,
    dt: float,
    prescribed: Mapping[str, PrescribedMotion],
    k: int,
    contact_candidates: ContactCandidates | None,
) -> tuple[ClothState, Tensor | None, Impulses]:
    """Advance by ``step``, or by the model's custom substep; in float32, carry the rounding error of positions over."""
    before, advance = state.x, step if model.custom_substep is None else model.custom_substep.advance
    state, impulses = advance(model, state, dt, prescribed, k, contact_candidates, compensation)
    if state.x.dtype == torch.float32:
        state, compensation = compensated_add(before, state, compensation, dt)
    return state, compensation, impulses


def compensated_add(
    before: Tensor, state: ClothState, compensation: Tensor | None, dt: float
) -> tuple[ClothState, Tensor]:
    """Add to the positions what earlier sums rounded away, and return what this sum rounds away (Kahan 1965).

    Substeps are short: at 1 mm/s they are one or two units in the last place of float32. The rounding would be the same
    in all of them, and slow grippers would move cloth twice as far, or not at all.
    """
    missing = (dt * state.v - (state.x - before)).detach()
    missing = missing if compensation is None else compensation + missing
    x = state.x + missing
    return state._replace(x=x), missing - (x - state.x).detach()


def energy(model: Model, state: ClothState) -> dict[str, Tensor]:
    """Compute the energies [...] J by name: kinetic, membrane, and director where there is contact."""
    s = surface(model.geometry, state.x, state.v)
    strained, area_share = elastic_deformation(model, s, state.memory)
    density = model.material.membrane_energy(model.coefficients, strained)
    energies = {
        "kinetic": 0.5 * (model.mass * dot(state.v, state.v)).sum((-2, -1)),
        "membrane": (s.area * (density if area_share is None else area_share * density)).sum((-2, -1)),
    }
    if model.grid is not None:
        energies["director"] = director_energy(model, model.grid, s, state.d3)
    return energies
