"""The algorithm on one page. Read this file first.

One substep:  internal variables -> forces on the mesh -> velocities -> contact through the grid -> boundaries ->
positions -> directors. Elasticity and effects act on the vertices, which carry all the mass; the grid carries only
contact. That split is what makes the solution converge when the step is halved: forces filtered through the grid do not.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor

from ._math import cross, dot
from .boundaries import AbstractBoundary, Drive
from .effects import AbstractEffect
from .materials import AbstractMaterial
from .transfer import exchange
from .types import ClothState, Memory, Moment, Surface


class Geometry(NamedTuple):
    """Constants of the mesh, in the layout that the substep reads."""

    corners: Tensor  # [3 E] int64, first all first corners, then all second, then all third
    warp: tuple[Tensor, Tensor]  # each [E, 1] 1/m: f1 = warp[0] d1 + warp[1] d2 with edges d1 = x1 - x0, d2 = x2 - x0
    weft: tuple[Tensor, Tensor]  # likewise f2
    area: Tensor  # [E, 1] m^2, rest
    points: Tensor  # [S, 3], barycentric coordinates of each triangle's contact points; S = 0 without contact
    spacing: float  # m, contact grid
    nodes: int  # per axis before the contact grid wraps


class Model(NamedTuple):
    """Everything a substep needs, with all parameters resolved to tensors."""

    geometry: Geometry
    mass: Tensor  # [..., V, 1] kg
    areal_density: Tensor  # [] or [..., 1 or E, 1] kg/m^2
    material: AbstractMaterial
    coefficients: Any
    effects: Mapping[str, tuple[AbstractEffect, Any]]
    boundaries: Mapping[str, AbstractBoundary]
    rest: Tensor | None = None  # [..., E or 1, 4]: F_E = F A for a rest shape that differs from the pattern


def surface(geometry: Geometry, x: Tensor, v: Tensor) -> Surface:
    """Kinematics of the triangles from vertex positions and velocities [..., V, 3]."""
    x0, x1, x2 = _corners(geometry, x)
    d1, d2 = x1 - x0, x2 - x0
    f1 = geometry.warp[0] * d1 + geometry.warp[1] * d2
    f2 = geometry.weft[0] * d1 + geometry.weft[1] * d2
    normal = cross(f1, f2)
    J = dot(normal, normal).sqrt()
    n = normal / J
    v0, v1, v2 = _corners(geometry, v)
    return Surface(f1, f2, cross(f2, n), cross(n, f1), n, J, geometry.area, (v0 + v1 + v2) / 3)


def step(model: Model, state: ClothState, dt: float, drives: Mapping[str, Drive], substep: int):
    """Advance one substep (symplectic Euler).

    Returns:
        (new state, impulses given to the cloth by driven boundaries: name -> [..., 6] N s, N m s)
    """
    geometry = model.geometry
    s = surface(geometry, state.x, state.v)
    memory = _evolve(model, state, s)
    columns = _membrane_stress(model, s, memory)
    touching = geometry.points.shape[0] > 0
    director = None
    if touching:
        director = _director_forces(model, s, state.d3)
        columns = (columns[0] + director.column1, columns[1] + director.column2)
    resistance = _resistance(model, s, state.x)
    force = _vertex_forces(model, state, s, memory, columns)
    free = state.v + dt * _resisted(resistance, force / model.mass)
    d3 = state.d3
    if director is not None:
        held, _ = _constrain(model, state.x, free, dt, drives, substep)
        change, d3 = _contact(model, state, held, s, director.pull, dt)
        free = free + _resisted(resistance, change)
    v, impulses = _constrain(model, state.x, free, dt, drives, substep)
    x = state.x + dt * v
    if touching:
        n = surface(geometry, x, v).n.unsqueeze(-2)
        split = d3.unflatten(-2, (-1, geometry.points.shape[0]))
        d3 = model.material.return_map(_per_point(model.coefficients), n, split).flatten(-3, -2)
    return ClothState(x, v, d3, memory), impulses


def rollout(model: Model, state: ClothState, dt: float, drives: Mapping[str, Drive], substeps: int, first: int = 0):
    """``substeps`` substeps from index ``first`` of the drives; impulses are summed."""
    total: dict[str, Tensor] = {}
    for k in range(first, first + substeps):
        state, impulses = step(model, state, dt, drives, k)
        total = {name: total[name] + value if name in total else value for name, value in impulses.items()}
    return state, total


def energy(model: Model, state: ClothState) -> dict[str, Tensor]:
    """Energies [...] J: kinetic, membrane, director."""
    s = surface(model.geometry, state.x, state.v)
    area = model.geometry.area
    elastic, share = _elastic(model, s, state.memory)
    density = model.material.membrane_energy(model.coefficients, elastic)
    out = {
        "kinetic": 0.5 * (model.mass * dot(state.v, state.v)).sum((-2, -1)),
        "membrane": (area * (density if share is None else share * density)).sum((-2, -1)),
    }
    points = model.geometry.points.shape[0]
    if points:
        split = state.d3.unflatten(-2, (-1, points))
        density = model.material.director_energy(_per_point(model.coefficients), s.n.unsqueeze(-2), split)
        out["director"] = (area.unsqueeze(-2) / points * density).sum((-3, -2, -1))
    return out


class _Director(NamedTuple):
    column1: Tensor  # [..., E, 3] N/m, reaction in the surface's columns; without it angular momentum breaks
    column2: Tensor
    pull: Tensor  # [..., P, 3] N m, area-weighted derivative with respect to d3, acts through the grid


def _director_forces(model: Model, s: Surface, d3: Tensor) -> _Director:
    """Split the director's stress into what acts on the surface columns (through n) and on d3 itself."""
    count = model.geometry.points.shape[0]
    split = d3.unflatten(-2, (-1, count))
    by_normal, by_director = model.material.director_stress(_per_point(model.coefficients), s.n.unsqueeze(-2), split)
    turn = by_normal.sum(-2) / count
    turn = (turn - dot(turn, s.n) * s.n) / s.J  # n has unit length: only its tangential change is real
    pull = (model.geometry.area.unsqueeze(-2) / count) * by_director
    return _Director(cross(s.f2, turn), cross(turn, s.f1), pull.flatten(-3, -2))


def _evolve(model: Model, state: ClothState, s: Surface) -> Memory:
    """Plastic set, internal friction and creases follow the cloth to where it is now."""
    memory = dict(state.memory)
    if "material" in memory:
        grown = s if model.rest is None else _unstretched(s, model.rest)
        memory["material"] = model.material.flow(model.coefficients, grown, memory["material"])
    for name, (effect, c) in model.effects.items():
        own = memory.get(f"effects.{name}")
        if own is not None:
            memory[f"effects.{name}"] = effect.evolve(c, Moment(state.x, state.v, s, model.mass, own))
    return memory


def _elastic(model: Model, s: Surface, memory: Memory) -> tuple[Surface, Tensor | None]:
    """(elastic deformation F A, true rest area over the pattern's or None for 1)."""
    share = None
    if model.rest is not None:
        s = _unstretched(s, model.rest)
        a11, a12, a21, a22 = model.rest.split(1, dim=-1)
        share = 1 / (a11 * a22 - a12 * a21)
    return (_unstretched(s, memory["material"]) if "material" in memory else s), share


def _unstretched(s: Surface, inverse: Tensor) -> Surface:
    """The surface seen from another rest shape: F -> F A with A [..., E or 1, 4] by rows."""
    a11, a12, a21, a22 = inverse.split(1, dim=-1)
    f1, f2 = a11 * s.f1 + a21 * s.f2, a12 * s.f1 + a22 * s.f2
    return s._replace(f1=f1, f2=f2, cofactor1=cross(f2, s.n), cofactor2=cross(s.n, f1), J=(a11 * a22 - a12 * a21) * s.J)


def _membrane_stress(model: Model, s: Surface, memory: Memory) -> tuple[Tensor, Tensor]:
    """Columns of d(energy)/dF per area of the pattern [..., E, 3] N/m: P = P_E A^T, times the growth of the area."""
    elastic, share = _elastic(model, s, memory)
    p1, p2 = model.material.membrane_stress(model.coefficients, elastic)
    for inverse in (memory.get("material"), model.rest):
        if inverse is not None:
            a11, a12, a21, a22 = inverse.split(1, dim=-1)
            p1, p2 = a11 * p1 + a12 * p2, a21 * p1 + a22 * p2
    return (p1, p2) if share is None else (share * p1, share * p2)


def _resistance(model: Model, s: Surface, x: Tensor) -> Tensor | None:
    """Mass that moves along with the normal only, relative to the vertices' own [..., V, 3, 3]; None without any."""
    found = [effect.inertia(c, s) for effect, c in model.effects.values()]
    triangles = [m for m in found if m is not None]
    if not triangles:
        return None
    share = (sum(triangles) / 3 * s.n).unsqueeze(-1) * s.n.unsqueeze(-2)
    flat = share.flatten(-2)
    total = _assemble(model.geometry, (flat, flat, flat), x[..., :1].expand(*x.shape[:-1], 9))
    return (total / model.mass).unflatten(-1, (3, 3))


def _resisted(resistance: Tensor | None, change: Tensor) -> Tensor:
    """(1 + B)^-1 y, written so that B = 0 changes nothing, bitwise."""
    if resistance is None:
        return change
    excess = (resistance @ change.unsqueeze(-1)).squeeze(-1)
    return change - torch.linalg.solve(torch.eye(3).to(change) + resistance, excess)


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
    total = _assemble(g, (first, second, third), state.x)
    return total if direct is None else total + direct


def _contact(model: Model, state: ClothState, v: Tensor, s: Surface, pull: Tensor, dt: float):
    """Contact of the points through the grid: (change of the vertices' velocities, moved directors)."""
    g = model.geometry
    count, batch = g.points.shape[0], state.x.shape[:-2]
    x_points, v_points = (_interpolate(g, field) for field in (state.x, v))
    mass = ((model.areal_density * g.area).unsqueeze(-2) / count).expand(*batch, -1, count, 1).flatten(-3, -2)
    affine = _mesh_gradient(g, v, s).unsqueeze(-3).expand(*batch, -1, count, 3, 3).flatten(-4, -3)
    inputs = (x_points, v_points, affine, mass, pull, state.d3)
    flat = (a.reshape(-1, *a.shape[len(batch) :]) for a in inputs)
    change, gradient = exchange(*flat, spacing=g.spacing, nodes=g.nodes, dt=dt)
    change, gradient = change.reshape(*batch, -1, 3), gradient.reshape(*batch, -1, 3, 3)
    momentum = (mass * change).unflatten(-2, (-1, count))
    a, b, c = (g.points[:, corner, None] for corner in range(3))
    shares = ((a * momentum).sum(-2), (b * momentum).sum(-2), (c * momentum).sum(-2))
    d3 = state.d3 + dt * (gradient @ state.d3.unsqueeze(-1)).squeeze(-1)
    return _assemble(g, shares, state.x) / model.mass, d3


def _mesh_gradient(g: Geometry, v: Tensor, s: Surface) -> Tensor:
    """Velocity gradient [..., E, 3, 3] 1/s of a sheet whose normal turns with it, exact for a rigid rotation."""
    v0, v1, v2 = _corners(g, v)
    d1, d2 = v1 - v0, v2 - v0
    rate1 = g.warp[0] * d1 + g.warp[1] * d2
    rate2 = g.weft[0] * d1 + g.weft[1] * d2
    dual1, dual2 = s.cofactor1 / s.J, s.cofactor2 / s.J
    spin = -(dot(rate1, s.n) * dual1 + dot(rate2, s.n) * dual2)  # rate of the normal
    left = torch.stack([rate1, rate2, spin], dim=-1)
    right = torch.stack([dual1, dual2, s.n], dim=-1)
    return left @ right.mT


def _constrain(model: Model, x: Tensor, v: Tensor, dt: float, drives: Mapping[str, Drive], substep: int):
    """Velocities that obey the boundaries, and what each driven one gave: impulse and its moment about the body."""
    impulses: dict[str, Tensor] = {}
    for name, boundary in model.boundaries.items():
        drive = drives.get(name)
        after = boundary.apply(x, v, dt, drive, substep)
        if drive is not None:
            after = _slipped(model, name, v, after, dt)
            momentum = model.mass * (after - v)
            arm = x + dt * after - drive.pose[..., substep, None, :3, 3]
            impulses[name] = torch.cat([momentum.sum(-2), cross(arm, momentum).sum(-2)], dim=-1)
        v = after
    return v, impulses


def _slipped(model: Model, grasp: str, free: Tensor, held: Tensor, dt: float) -> Tensor:
    for effect, c in model.effects.values():
        if effect.grasp == grasp:
            index = cast("Tensor", model.boundaries[grasp].index)
            held = effect.loosen(c, index, free, held, model.mass, dt)
    return held


def _corners(g: Geometry, field: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Values [..., E, 3] at the triangles' three corners."""
    return field.index_select(-2, g.corners).unflatten(-2, (3, -1)).unbind(-3)  # type: ignore[return-value]


def _interpolate(g: Geometry, field: Tensor) -> Tensor:
    """Values [..., P, 3] at the contact points."""
    a, b, c = (corner.unsqueeze(-2) for corner in _corners(g, field))
    u, v, w = (g.points[:, k, None] for k in range(3))
    return (u * a + v * b + w * c).flatten(-3, -2)


def _assemble(g: Geometry, shares: tuple[Tensor, Tensor, Tensor], like: Tensor) -> Tensor:
    """Sum the corners' shares [..., E, 3] on the vertices [..., V, 3]."""
    stacked = torch.cat(shares, dim=-2)
    index = g.corners.unsqueeze(-1).expand(stacked.shape)  # scatter_add: 7 times faster than index_add here
    return torch.zeros_like(like).expand(*stacked.shape[:-2], -1, -1).scatter_add(-2, index, stacked)


def _per_point(coefficients: Any) -> Any:
    """The material's coefficients with an axis for the contact points of a triangle."""
    return type(coefficients)(*(c.unsqueeze(-2) for c in coefficients))
