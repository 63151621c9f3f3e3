"""APIC, the usual material point scheme, for comparison (Jiang, Gast, Teran 2017): all forces pass through the grid.

Vertices and triangles are particles; a quarter of a triangle's mass goes to each corner and to itself. The transfer
filters velocities at every substep, so its damping depends on dt. docs/validation/verification.md shows both schemes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import cast

import torch
from torch import Tensor

import torchcloth as tc
from torchcloth.boundaries import AbstractBoundary, PrescribedMotion
from torchcloth.dynamics.contact import Grid, affine_momentum, place_on_grid, stencil_nodes, sum_on_nodes
from torchcloth.dynamics.contact.self_contact import (
    ContactCandidates,
    add_director_stress,
    coefficients_per_point,
    compute_director_forces,
    find_contact_candidates,
)
from torchcloth.dynamics.elasticity import membrane_stress, update_memory
from torchcloth.dynamics.forces import Impulses, apply_boundaries, vertex_forces
from torchcloth.dynamics.kinematics import centroids, surface
from torchcloth.dynamics.model import CustomSubstep, Model
from torchcloth.effects import AbstractEffect
from torchcloth.engine.dispatch import Setting
from torchcloth.errors import InvalidInput
from torchcloth.types import ClothState, Memory, Surface, Trajectory

MEMORY_NAME = "apic"  # name of the affine velocities in ClothState.memory


class APICCloth(tc.Cloth):
    """A cloth whose forces all pass through the contact grid, as in the usual material point method.

    Triangles have one contact point each. Contact has no play and no collision damping, and air adds no mass. Wrenches
    leave out what the grid takes up, some per cent of the weight. Only the torch reference computes it.

    Args:
        mesh: as for ``torchcloth.Cloth``.
        material: likewise.
        areal_density: likewise.
        effects: likewise.
        boundaries: likewise.
        contact: likewise, but not None: the scheme needs its grid.
        engine: likewise.

    Raises:
        InvalidInput: no contact, or a part that does not fit.
    """

    def __init__(
        self,
        mesh: tc.meshes.Mesh,
        material: tc.materials.AbstractMaterial,
        areal_density: float | Tensor,
        effects: Mapping[str, AbstractEffect] | None = None,
        boundaries: Mapping[str, AbstractBoundary] | None = None,
        contact: tc.Contact | None = tc.Contact(),  # noqa: B008 - frozen, carries no state
        engine: Setting = "auto",
    ) -> None:
        if contact is None:
            raise InvalidInput("contact", got="None", expected="a Contact: APIC needs its grid")
        contact = replace(contact, subdivisions=1, everywhere=True, free_compression=0.0, damping=0.0)
        super().__init__(mesh, material, areal_density, effects, boundaries, contact, engine)

    def build_model(self) -> Model:
        """Return the model of ``Cloth``, with APIC as its substep."""
        return super().build_model()._replace(custom_substep=APIC)

    def settle(
        self,
        state: ClothState,
        motion: Mapping[str, Trajectory] | None = None,
        *,
        start: float = 0.0,
        duration: float = 0.3,
        rate: float = 30.0,
    ) -> ClothState:
        """Let the cloth come to rest as ``Cloth.settle`` does, and stop the particles' affine velocities, too."""
        settled = super().settle(state, motion, start=start, duration=duration, rate=rate)
        return settled._replace(memory={**settled.memory, MEMORY_NAME: torch.zeros_like(settled.memory[MEMORY_NAME])})


def step(
    model: Model,
    state: ClothState,
    dt: float,
    prescribed: Mapping[str, PrescribedMotion],
    substep: int,
    contact_candidates: ContactCandidates | None = None,
    compensation: Tensor | None = None,
) -> tuple[ClothState, Impulses]:
    """Advance the cloth by one substep, as the ``advance`` of a ``CustomSubstep``.

    ``state.memory["apic"]`` [..., V + E, 9] 1/s are the affine velocities of the particles: vertices, then triangles.
    """
    grid = cast("Grid", model.grid)  # APICCloth refuses to be made without
    s = surface(model.geometry, state.x, state.v, compensation)
    memory = update_memory(model, state, s, dt, compensation)
    if contact_candidates is None:
        contact_candidates = find_contact_candidates(model, grid, state.x)
    director_forces = compute_director_forces(model, grid, contact_candidates, state, s, dt, substep)
    stress = add_director_stress(contact_candidates, membrane_stress(model, s, memory), director_forces)

    # weight and air drag act on triangles, too: they change velocities before the grid. Air has no added mass here
    zero_stress = (torch.zeros_like(stress[0]), torch.zeros_like(stress[1]))
    effects = {name: (effect, c) for name, (effect, c) in model.effects.items() if effect.inertia(c, s) is None}
    model_without_air = model._replace(effects=effects)
    effect_force = vertex_forces(model_without_air, state, s, memory, zero_stress, compensation)
    stress_force = vertex_forces(model_without_air, state, s, memory, stress, compensation) - effect_force
    v = state.v + dt * effect_force / model.mass

    batch, vertices = state.x.shape[:-2], state.x.shape[-2]
    position, velocity = (
        torch.cat([field, centroids(model.geometry, field)], dim=-2).reshape(-1, 3) for field in (state.x, v)
    )
    mass = _particle_masses(model, state, s).reshape(-1, 1)
    particles = position.shape[0] // max(1, batch.numel())  # of one scene
    scene = torch.arange(batch.numel(), device=position.device).repeat_interleave(particles)
    nodes = place_on_grid(position, mass, scene, grid, contact_candidates.node_scratch, grid.shift(substep))

    affine = memory[MEMORY_NAME].reshape(-1, 3, 3)
    momentum = affine_momentum(nodes, mass, velocity, affine, grid.spacing)
    slope = nodes.weight_gradient.unflatten(0, (-1, particles))[:, vertices:].flatten(0, 1)
    triangle_force = -(slope @ director_forces.d3.unsqueeze(-1)) * director_forces.energy_by_d3.unsqueeze(-2)
    weight = nodes.weight.unflatten(0, (-1, particles))[:, :vertices].flatten(0, 1)
    vertex_force = weight.unsqueeze(-1) * stress_force.reshape(-1, 1, 3)
    particle_force = torch.cat(
        [part.unflatten(0, (batch.numel(), -1)) for part in (vertex_force, triangle_force)], dim=1
    ).flatten(0, 1)
    node_momentum = sum_on_nodes(nodes.node, momentum + dt * particle_force)
    node_velocity = node_momentum * nodes.inverse_mass.unsqueeze(-1)

    arm = (stencil_nodes(position) - nodes.offset.unsqueeze(-2)) * grid.spacing
    weighted_velocity = nodes.weight.unsqueeze(-1) * node_velocity
    memory[MEMORY_NAME] = (4 / grid.spacing**2 * weighted_velocity.mT @ arm).view(*batch, particles, 9)
    free = weighted_velocity.sum(-2).view(*batch, particles, 3)[..., :vertices, :]
    v, impulses = apply_boundaries(model, state.x, free, dt, prescribed, substep, None)
    x = state.x + dt * v

    gradient = (node_velocity.mT @ nodes.weight_gradient).unflatten(0, (-1, particles))[:, vertices:].flatten(0, 1)
    d3 = director_forces.d3 + dt * (gradient @ director_forces.d3.unsqueeze(-1)).squeeze(-1)
    n = surface(model.geometry, x, v).n.reshape(-1, 1, 3)
    d3 = model.material.return_map(coefficients_per_point(model, contact_candidates, s), n, d3.unsqueeze(-2))
    return ClothState(x, v, d3.view(state.d3.shape), memory), impulses


def _particle_masses(model: Model, state: ClothState, s: Surface) -> Tensor:
    """Return masses [..., V + E, 1] kg of vertices, then triangles.

    A triangle takes a quarter of its fabric's mass from its corners. What effects add stays with the vertices.
    """
    triangle = (model.areal_density * s.area / 4).expand(*s.n.shape[:-1], 1)
    vertex = model.mass.expand(*state.x.shape[:-1], 1)
    corners = torch.cat([triangle / 3] * 3, dim=-2)
    return torch.cat([vertex.index_add(-2, model.geometry.corners, corners, alpha=-1), triangle], dim=-2)


def initial_memory(x: Tensor, triangles: int) -> Memory:
    """Return affine velocities of zero for vertices at x [..., V, 3] m and so many triangles."""
    return {MEMORY_NAME: x.new_zeros(*x.shape[:-2], x.shape[-2] + triangles, 9)}


APIC = CustomSubstep("apic", step, initial_memory)
