"""Forces on the vertices, the added mass of air, and the boundaries."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

import torch
from torch import Tensor

from .._utils.linalg import apply_added_mass, cross
from ..boundaries import AbstractCollider, PrescribedMotion
from ..effects import AbstractEffect
from ..errors import InvalidInput
from ..types import ClothState, EffectInputs, Memory, Surface
from .kinematics import assemble
from .model import Model

# name of a driven boundary -> [..., 6] N s, N m s: impulse that it gave the cloth, and its moment about the body
Impulses = dict[str, Tensor]


def add_impulses(total: Impulses, more: Impulses) -> Impulses:
    """Return the impulses of two consecutive spans of time together."""
    return {name: total[name] + value if name in total else value for name, value in more.items()}


def vertex_forces(
    model: Model,
    state: ClothState,
    s: Surface,
    memory: Memory,
    stress: tuple[Tensor, Tensor],
    compensation: Tensor | None = None,
) -> Tensor:
    """Assemble internal forces and effects on the vertices, [..., V, 3] N.

    Where the model has viscous stages, the viscous part of each effect is left out: ``viscous_stages`` applies it.

    Args:
        model: the model.
        state: positions and velocities.
        s: kinematics of the triangles.
        memory: internal variables at this time.
        stress: columns [..., E, 3] N/m of the first Piola-Kirchhoff stress resultant.
        compensation: as of ``substep.step``.

    Raises:
        InvalidInput: a force of another shape than its effect promises, or a viscous force that acts on triangles.
    """
    g = model.geometry
    p1, p2 = stress
    second = -g.area * (g.warp[0] * p1 + g.weft[0] * p2)
    third = -g.area * (g.warp[1] * p1 + g.weft[1] * p2)
    first = -(second + third)
    on_vertices = None
    for name, (effect, c) in model.effects.items():
        inputs = EffectInputs(state.x, state.v, s, model.mass, memory.get(f"effects.{name}"), compensation=compensation)
        force = effect_force(name, effect, c, inputs)
        if force is None:
            continue
        in_stages = effect.viscous(c, inputs) if model.stages else None
        if in_stages is not None and effect.acts_on == "triangles":
            raise InvalidInput(f"effect {name!r}", got="viscous forces of triangles", expected='acts_on = "vertices"')
        force = force if in_stages is None else force - in_stages
        if effect.acts_on == "triangles":
            share = force / 3
            first, second, third = first + share, second + share, third + share
        else:
            on_vertices = force if on_vertices is None else on_vertices + force
    total = assemble(g, (first, second, third), state.x)
    return total if on_vertices is None else total + on_vertices


def effect_force(name: str, effect: AbstractEffect, c: Any, inputs: EffectInputs) -> Tensor | None:
    """Return the force of an effect, [..., V or E, 3] N, or None where it has none.

    Raises:
        InvalidInput: another shape than the effect promises.
    """
    force = effect.force(c, inputs)
    rows = (inputs.x if effect.acts_on == "vertices" else inputs.surface.n).shape[-2]
    if force is not None and force.shape[-2:] != (rows, 3):
        expected = f"[..., {rows}, 3], a row for each of the {effect.acts_on}"
        raise InvalidInput(f"force of effect {name!r}", got=f"shape {tuple(force.shape)}", expected=expected)
    return force


def compute_added_mass_ratio(model: Model, s: Surface, x: Tensor) -> Tensor | None:
    """Compute B = sum m_air (n (x) n) / m_vertex, [..., V, 3, 3]; None without any added mass.

    The air has inertia along the triangles' normals only, so 1 + B is the mass matrix of a vertex over its own mass.
    """
    inertias = [effect.inertia(c, s) for effect, c in model.effects.values()]
    per_triangle = [inertia for inertia in inertias if inertia is not None]
    if not per_triangle:
        return None
    share = (sum(per_triangle) / 3 * s.n).unsqueeze(-1) * s.n.unsqueeze(-2)
    flat = share.flatten(-2)
    total = assemble(model.geometry, (flat, flat, flat), x[..., :1].expand(*x.shape[:-1], 9))
    return (total / model.mass).unflatten(-1, (3, 3))


def apply_boundaries(
    model: Model,
    x: Tensor,
    v: Tensor,
    dt: float,
    prescribed: Mapping[str, PrescribedMotion],
    substep: int,
    added_mass_ratio: Tensor | None,
) -> tuple[Tensor, Impulses]:
    """Change velocities [..., V, 3] m/s so that they obey all boundaries, and record what each driven one gave.

    Returns:
        The new velocities; and by boundary the impulse on the cloth and on the air that moves along [N s], with its
        moment [N m s] about the body's origin at the start of the substep. With the positions of that time, angular
        momentum balances.
    """
    impulses: Impulses = {}
    for name, boundary in model.boundaries.items():
        motion = prescribed.get(name)
        if isinstance(boundary, AbstractCollider):
            after = boundary.constrain(x, v, dt, motion, substep, added_mass_ratio, model.mass)
        else:
            after = boundary.constrain(x, v, dt, motion, substep)
        if motion is not None:
            for effect, c in model.effects.values():
                if effect.grasp == name:
                    index = cast("Tensor", model.boundaries[name].index)
                    after = effect.grip_velocities(c, index, v, after, model.mass, dt, added_mass_ratio)
            momentum = model.mass * apply_added_mass(added_mass_ratio, after - v)
            increment, end = motion.increment[..., substep, :, :], motion.pose[..., substep, None, :3, 3]
            origin = (end - increment[..., None, :3, 3]) @ increment[..., :3, :3]
            impulses[name] = torch.cat([momentum.sum(-2), cross(x - origin, momentum).sum(-2)], dim=-1)
        v = after
    return v, impulses
