"""Contact between layers of cloth: which triangles are near another layer, and what the grid does to them.

Away from other layers a director would only follow its own sheet, so it simply is the normal there, and costs nothing.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..._utils.linalg import EXACT_CDIST_MODE, cross, dot
from ...types import ClothState, Surface
from ..kinematics import centroids, corners, surface
from ..model import Model
from . import (
    APPROACH_PER_COMPRESSION_SPACINGS,
    COMPRESSION_ONSET_SPACINGS,
    INTERACTION_RANGE_SPACINGS,
    SEARCH_SKIN_SPACINGS,
    Grid,
    Stencil,
    place_on_grid,
    transfer_director_forces,
    velocity_gradient,
)

# Substeps between checkpoints of a long interval: memory ~ frames + CHUNK, one extra forward pass. Near layers are
# searched again at each, as substeps that are computed anew start there.
SUBSTEPS_PER_CHECKPOINT = 48


class ContactCandidates(NamedTuple):
    """Triangles near another layer, over all scenes of the batch, while no vertex has moved far from ``x``."""

    active: Tensor  # [A] int64, scene E + triangle
    scene: Tensor  # [A] int64
    vertices: Tensor  # [3, A] int64, scene V + vertex
    slots: Tensor  # int32, scratch of the grid: one per node
    x: Tensor  # [..., V, 3] m


class DirectorForces(NamedTuple):
    """What the directors of the active triangles do."""

    column1: Tensor  # [A, 3] N/m, reaction in the surface's columns; without it angular momentum breaks
    column2: Tensor
    pull: Tensor  # [A S, 3] N m, area-weighted derivative with respect to d3, acts through the grid
    d3: Tensor  # [A S, 3]
    mass: Tensor  # [A S, 1] kg, of the points
    nodes: Stencil


@torch.no_grad()
def find_contact_candidates(model: Model, grid: Grid, x: Tensor, previous: ContactCandidates | None = None) -> ContactCandidates:
    """Triangles whose points may meet those of another layer before a vertex has moved by half the grid's skin
    along any axis.

    Another layer is what is near in space but far along the cloth.
    """
    if previous is not None and float((x - previous.x).abs().max()) < grid.skin / 2:
        return previous
    x = x.detach()
    centre = centroids(model.geometry, x.reshape(-1, *x.shape[-2:]))
    if grid.non_adjacent is None:
        near = torch.ones(centre.shape[:2], dtype=torch.bool, device=x.device)
    else:
        near = torch.stack(
            [((torch.cdist(p, p, compute_mode=EXACT_CDIST_MODE) < grid.reach) & grid.non_adjacent).any(-1) for p in centre]
        )
    scene, triangle = near.nonzero(as_tuple=True)
    scenes, triangles = near.shape
    own = model.geometry.corners.view(3, -1).index_select(1, triangle) + scene * x.shape[-2]
    slots = torch.empty(scenes * grid.nodes**3 if len(scene) else 0, dtype=torch.int32, device=x.device)
    return ContactCandidates(scene * triangles + triangle, scene, own, slots, x)


def initial_directors(model: Model, grid: Grid, x: Tensor) -> Tensor:
    """Directors [..., P, 3] of a cloth whose layers have come to where they are without being pressed.

    Layers that start within each other's splines would else have to give way by the whole play from there.
    """
    d3 = n = surface(model.geometry, x, x).n
    if grid.non_adjacent is not None and grid.free_compression > 0:
        d3 = (1 - _unpressed(grid, grid.non_adjacent, centroids(model.geometry, x), n)) * n
    return d3.repeat_interleave(grid.points.shape[0], dim=-2)


def _unpressed(grid: Grid, apart: Tensor, centre: Tensor, n: Tensor) -> Tensor:
    """Compression [..., E, 1] at which layers that are as near as the triangles with these centres do not yet press."""
    side = (grid.reach - (INTERACTION_RANGE_SPACINGS + SEARCH_SKIN_SPACINGS) * grid.spacing) / 2
    farthest = COMPRESSION_ONSET_SPACINGS * grid.spacing + side  # pairs beyond do not press, whatever their direction
    found = []
    for points, normals in zip(centre.reshape(-1, *n.shape[-2:]), n.reshape(-1, *n.shape[-2:]), strict=True):
        fixed = points.detach()  # which pairs; how near they are has derivatives
        over, under = ((torch.cdist(fixed, fixed, compute_mode=EXACT_CDIST_MODE) <= farthest) & apart).nonzero(as_tuple=True)
        between = points[over] - points[under]
        height = dot(between, normals[under]).abs()
        beside = (dot(between, between) - height**2).clamp(min=0).sqrt() > side
        close = ((COMPRESSION_ONSET_SPACINGS - height / grid.spacing) / APPROACH_PER_COMPRESSION_SPACINGS).masked_fill(beside, 0.0).clamp(0, grid.free_compression)
        found.append(points.new_zeros(len(points), 1).scatter_reduce(0, over.unsqueeze(-1), close, "amax"))
    return torch.stack(found).view(*n.shape[:-1], 1)


def compute_director_forces(model: Model, grid: Grid, layers: ContactCandidates, state: ClothState, s: Surface, dt: float) -> DirectorForces:
    """Split the director's stress into what acts on the surface columns (through n) and on d3 itself.

    The collision's damping knows the rate of closing from the substep before; divided as if it were implicit, it stays
    stable however hard layers are pressed.
    """
    count = grid.points.shape[0]
    n, J, f1, f2, area = (_pick(layers, field, s.n) for field in (s.n, s.J, s.f1, s.f2, s.area))
    d3 = state.d3.reshape(-1, count, 3).index_select(0, layers.active)
    normal = n.unsqueeze(-2)
    by_normal, by_director = model.material.director_stress(
        coefficients_per_point(model, layers, s), normal, d3 + grid.free_compression * normal
    )
    by_normal = by_normal + grid.free_compression * by_director
    closing = state.memory["contact"].reshape(-1, count, 1).index_select(0, layers.active)
    press = dot(by_director, normal).clamp(max=0)
    density = _pick(layers, model.areal_density, s.n).unsqueeze(-2)
    slowed = 1 - (2 * dt * grid.damping / (APPROACH_PER_COMPRESSION_SPACINGS * grid.spacing) ** 2) * press / density
    loss = press * (grid.damping * closing / slowed).clamp(min=-1)
    by_normal, by_director = by_normal + loss * d3, by_director + loss * normal
    turn = by_normal.sum(-2) / count
    turn = (turn - dot(turn, n) * n) / J  # n has unit length: only its tangential change is real
    pull = (area.unsqueeze(-2) / count) * by_director
    mass = _each(_pick(layers, model.areal_density * s.area, s.n) / count, count)
    nodes = place_on_grid(_points(grid, layers, state.x), mass, _each(layers.scene, count), grid, layers.slots)
    return DirectorForces(cross(f2, turn), cross(turn, f1), pull.flatten(0, 1), d3.flatten(0, 1), mass, nodes)


def add_director_stress(layers: ContactCandidates, columns: tuple[Tensor, Tensor], p: DirectorForces) -> tuple[Tensor, Tensor]:
    """Membrane stress columns [..., E, 3] with the directors' reaction."""
    first, second = (
        column.reshape(-1, 3).index_add(0, layers.active, extra).view(column.shape)
        for column, extra in zip(columns, (p.column1, p.column2), strict=True)
    )
    return first, second


def contact_velocity_change(model: Model, grid: Grid, layers: ContactCandidates, p: DirectorForces, s: Surface, like: Tensor, dt: float) -> Tensor:
    """Change of the vertices' velocities [..., V, 3] m/s by contact.

    The exact transpose of how vertices carry velocity to the nodes, with the affine part: momentum and its moment are
    kept to rounding, and contact is as symmetric as elasticity.
    """
    count = grid.points.shape[0]
    change, moment = transfer_director_forces(p.nodes, p.pull, p.d3, grid.spacing, dt)
    momentum = (p.mass * change).unflatten(0, (-1, count))
    shares = torch.stack([(grid.points[:, corner, None] * momentum).sum(-2) for corner in range(3)])
    shares = shares + _affine_shares(model, layers, s, (p.mass.unsqueeze(-1) * moment).unflatten(0, (-1, count)).sum(1))
    total = torch.zeros_like(like).reshape(-1, 3).index_add(0, layers.vertices.flatten(), shares.flatten(0, 1))
    return total.view(like.shape) / model.mass


def _affine_shares(model: Model, layers: ContactCandidates, s: Surface, moment: Tensor) -> Tensor:
    """Impulses [3, A, 3] N s at the corners: the transpose of ``_mesh_gradient`` applied to ``moment`` [A, 3, 3]."""
    n, J, dual1, dual2 = (_pick(layers, field, s.n) for field in (s.n, s.J, s.cofactor1, s.cofactor2))
    dual1, dual2 = dual1 / J, dual2 / J
    normal = _times(moment, n)
    first = _times(moment, dual1) - dot(normal, dual1) * n
    second = _times(moment, dual2) - dot(normal, dual2) * n
    warp, weft = ([_pick(layers, part, s.n) for part in pair] for pair in (model.geometry.warp, model.geometry.weft))
    b, c = (warp[k] * first + weft[k] * second for k in range(2))
    return torch.stack([-(b + c), b, c])


def _times(matrix: Tensor, vector: Tensor) -> Tensor:
    return (matrix @ vector.unsqueeze(-1)).squeeze(-1)


def advance_directors(
    model: Model, grid: Grid, layers: ContactCandidates, p: DirectorForces | None, s: Surface, v: Tensor, now: Surface, dt: float
) -> tuple[Tensor, Tensor]:
    """Directors [..., P, 3] carried by the velocities v that the cloth got and mapped back, and how fast they close.

    Far from other layers they are the normals. Closing is -dR33/dt [..., P, 1] 1/s. ``s`` is the surface that the
    velocities act on, ``now`` the one after the substep. The velocities on the nodes are those of the cloth: contact
    forces act on the nodes between layers at every substep anew, and a director that followed them there would slowly
    forget its compression (layers then sink into each other at a speed proportional to dt).
    """
    count = grid.points.shape[0]
    d3 = now.n.repeat_interleave(count, dim=-2)
    closing = torch.zeros_like(d3[..., :1])
    if p is None:
        return d3, closing
    affine = _pick(layers, _mesh_gradient(model, v, s).flatten(-2), s.n).unflatten(-1, (3, 3))
    gradient = velocity_gradient(p.nodes, p.mass, _points(grid, layers, v), _each(affine, count), grid.spacing)
    moved = p.d3 + dt * (gradient @ p.d3.unsqueeze(-1)).squeeze(-1)
    before, after = (field.unflatten(0, (-1, count)) for field in (p.d3, moved))
    old, n = (_pick(layers, field, field).unsqueeze(-2) for field in (s.n, now.n))
    height = dot(after, n)
    mapped = model.material.return_map(coefficients_per_point(model, layers, s), n, after + grid.free_compression * n) - grid.free_compression * n
    mapped = torch.where(height > 1 - grid.free_compression, height.clamp(max=1) * n, mapped)
    rate = (dot(before, old) - height) / dt
    return _put(layers, d3, mapped), _put(layers, closing, rate)


def director_energy(model: Model, grid: Grid, s: Surface, d3: Tensor) -> Tensor:
    """[...] J, of all directors."""
    count = grid.points.shape[0]
    c = type(model.coefficients)(*(k.unsqueeze(-2) for k in model.coefficients))
    n = s.n.unsqueeze(-2)
    density = model.material.director_energy(c, n, d3.unflatten(-2, (-1, count)) + grid.free_compression * n)
    return (s.area.unsqueeze(-2) / count * density).sum((-3, -2, -1))


def _mesh_gradient(model: Model, v: Tensor, s: Surface) -> Tensor:
    """Velocity gradient [..., E, 3, 3] 1/s of a sheet whose normal turns with it, exact for a rigid rotation."""
    g = model.geometry
    v0, v1, v2 = corners(g, v)
    d1, d2 = v1 - v0, v2 - v0
    rate1 = g.warp[0] * d1 + g.warp[1] * d2
    rate2 = g.weft[0] * d1 + g.weft[1] * d2
    dual1, dual2 = s.cofactor1 / s.J, s.cofactor2 / s.J
    spin = -(dot(rate1, s.n) * dual1 + dot(rate2, s.n) * dual2)  # rate of the normal
    left = torch.stack([rate1, rate2, spin], dim=-1)
    right = torch.stack([dual1, dual2, s.n], dim=-1)
    return left @ right.mT


def _pick(layers: ContactCandidates, field: Tensor, like: Tensor) -> Tensor:
    """Rows [A, K] of a field [..., E or 1, K] at the active triangles; ``like`` is [..., E, 3]."""
    full = field.expand(*like.shape[:-1], field.shape[-1])
    return full.reshape(-1, field.shape[-1]).index_select(0, layers.active)


def _put(layers: ContactCandidates, field: Tensor, rows: Tensor) -> Tensor:
    """The field [..., P, K] with the rows [A, S, K] of the active triangles replaced."""
    return field.reshape(-1, *rows.shape[1:]).index_copy(0, layers.active, rows).view(field.shape)


def _each(rows: Tensor, count: int) -> Tensor:
    """Rows of triangles repeated for their contact points."""
    return rows.repeat_interleave(count, 0)


def _points(grid: Grid, layers: ContactCandidates, field: Tensor) -> Tensor:
    """Values [A S, 3] at the contact points of the active triangles."""
    own = field.reshape(-1, 3).index_select(0, layers.vertices.flatten()).unflatten(0, (3, -1))
    return torch.einsum("sc,cak->ask", grid.points, own).flatten(0, 1)


def coefficients_per_point(model: Model, layers: ContactCandidates, s: Surface) -> Any:
    """The material's coefficients at the active triangles, with an axis for the contact points."""
    coefficients = model.coefficients
    return type(coefficients)(*(_pick(layers, c, s.n).unsqueeze(-2) for c in coefficients))
