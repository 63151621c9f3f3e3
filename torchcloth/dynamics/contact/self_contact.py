"""Contact between layers of cloth: which triangles are near another layer, and what the grid does to them.

Every contact point carries a director d3, which is compressed and sheared where layers press on each other. Away from
other layers a director would only follow its own sheet, so it is set to the normal there and costs nothing. A substep
calls ``find_contact_candidates``, ``compute_director_forces``, ``add_director_stress``, ``contact_velocity_change`` and
``advance_directors``, in this order.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..._utils.linalg import EXACT_CDIST_MODE, cross, dot, matvec
from ...types import ClothState, Surface
from ..kinematics import centroids, corners, surface
from ..model import Model
from .compression import COMPRESSION_PER_SPACING, RANGE_SPACINGS, compression_at
from .grid import INTERACTION_RANGE_SPACINGS, SEARCH_SKIN_SPACINGS, Grid
from .transfer import Stencil, place_on_grid, transfer_director_forces, velocity_gradient

# Of a long interval: memory grows as frames + SUBSTEPS_PER_CHECKPOINT, for one extra forward pass. Candidates are
# searched again at each checkpoint, because substeps that are recomputed start there.
SUBSTEPS_PER_CHECKPOINT = 48


class ContactCandidates(NamedTuple):
    """Active triangles: those near another layer, over all scenes of the batch, while no vertex is far from ``x``.

    Attributes:
        active: [A] int64, scene E + triangle.
        scene: [A] int64.
        vertices: [3, A] int64, scene V + vertex.
        node_scratch: int32, work memory of ``place_on_grid``, one entry per node of the grid.
        x: [..., V, 3] m, positions at the search.
    """

    active: Tensor
    scene: Tensor
    vertices: Tensor
    node_scratch: Tensor
    x: Tensor


class DirectorForces(NamedTuple):
    """Forces of the directors of the A active triangles, with S contact points each.

    Attributes:
        column1: [A, 3] N/m, reaction in the warp column of the surface; without it angular momentum is not conserved.
        column2: [A, 3] N/m, reaction in the weft column.
        energy_by_d3: [A S, 3] N m, derivative of a director's energy with respect to d3, which acts through the grid.
        d3: [A S, 3] -, directors.
        mass: [A S, 1] kg, masses of the points.
        nodes: the points' nodes.
    """

    column1: Tensor
    column2: Tensor
    energy_by_d3: Tensor
    d3: Tensor
    mass: Tensor
    nodes: Stencil


@torch.no_grad()
def find_contact_candidates(
    model: Model, grid: Grid, x: Tensor, previous: ContactCandidates | None = None
) -> ContactCandidates:
    """Find the triangles whose points may meet another layer before a vertex moves by half of ``grid.search_skin``.

    Another layer is what is near in space but far along the cloth.

    Args:
        model: the model.
        grid: the contact grid.
        x: [..., V, 3] m.
        previous: result of an earlier search, returned if no vertex has moved that far along any axis since.
    """
    if previous is not None and float((x - previous.x).abs().max()) < grid.search_skin / 2:
        return previous
    x = x.detach()
    centre = centroids(model.geometry, x.reshape(-1, *x.shape[-2:]))
    if grid.non_adjacent is None:
        near = torch.ones(centre.shape[:2], dtype=torch.bool, device=x.device)
    else:
        within_reach = (torch.cdist(p, p, compute_mode=EXACT_CDIST_MODE) < grid.reach for p in centre)
        near = torch.stack([(pairs & grid.non_adjacent).any(-1) for pairs in within_reach])
    scene, triangle = near.nonzero(as_tuple=True)
    scenes, triangles = near.shape
    vertices = model.geometry.corners.view(3, -1).index_select(1, triangle) + scene * x.shape[-2]
    node_scratch = torch.empty(scenes * grid.nodes**3 if len(scene) else 0, dtype=torch.int32, device=x.device)
    return ContactCandidates(scene * triangles + triangle, scene, vertices, node_scratch, x)


def initial_directors(model: Model, grid: Grid, x: Tensor) -> Tensor:
    """Return directors [..., P, 3] of a cloth whose layers have come to their places without being pressed.

    Layers that start within each other's splines would otherwise give way by the whole free compression from there.
    """
    d3 = n = surface(model.geometry, x, x).n
    if grid.non_adjacent is not None and grid.free_compression > 0:
        d3 = (1 - _unpressed_compression(grid, grid.non_adjacent, centroids(model.geometry, x), n)) * n
    return d3.repeat_interleave(grid.points.shape[0], dim=-2)


def _unpressed_compression(grid: Grid, non_adjacent: Tensor, centre: Tensor, n: Tensor) -> Tensor:
    """Return the compression [..., E, 1] at which layers as near as these triangles do not yet press."""
    side = (grid.reach - (INTERACTION_RANGE_SPACINGS + SEARCH_SKIN_SPACINGS) * grid.spacing) / 2
    pressing_range = RANGE_SPACINGS * grid.spacing + side  # for pairs in any direction
    compressions = []
    for points, normals in zip(centre.reshape(-1, *n.shape[-2:]), n.reshape(-1, *n.shape[-2:]), strict=True):
        fixed = points.detach()  # which pairs are near has no derivative; how near they are has
        within_range = torch.cdist(fixed, fixed, compute_mode=EXACT_CDIST_MODE) <= pressing_range
        over, under = (within_range & non_adjacent).nonzero(as_tuple=True)
        between = points[over] - points[under]
        height = dot(between, normals[under]).abs()
        is_lateral = (dot(between, between) - height**2).clamp(min=0).sqrt() > side
        compression = compression_at(height / grid.spacing)
        compression = compression.masked_fill(is_lateral, 0.0).clamp(0, grid.free_compression)
        largest = points.new_zeros(len(points), 1).scatter_reduce(0, over.unsqueeze(-1), compression, "amax")
        compressions.append(largest)
    return torch.stack(compressions).view(*n.shape[:-1], 1)


def compute_director_forces(
    model: Model, grid: Grid, candidates: ContactCandidates, state: ClothState, s: Surface, dt: float, substep: int
) -> DirectorForces:
    """Split the directors' stress into what acts on the surface columns (through n) and on d3 itself.

    ``substep`` decides where the grid lies.

    The collision's damping uses the rate of closing from the substep before. Divided as if it were implicit, it is
    stable however hard layers are pressed.
    """
    points_per_triangle = grid.points.shape[0]
    n, J, f1, f2, area = (_select_active(candidates, field, s.n) for field in (s.n, s.J, s.f1, s.f2, s.area))
    d3 = state.d3.reshape(-1, points_per_triangle, 3).index_select(0, candidates.active)
    normal = n.unsqueeze(-2)
    by_normal, by_director = model.material.director_stress(
        coefficients_per_point(model, candidates, s), normal, d3 + grid.free_compression * normal
    )
    by_normal = by_normal + grid.free_compression * by_director

    closing = state.memory["contact"].reshape(-1, points_per_triangle, 1).index_select(0, candidates.active)
    pressure = dot(by_director, normal).clamp(max=0)
    density = _select_active(candidates, model.areal_density, s.n).unsqueeze(-2)
    implicit = 1 - (2 * dt * grid.damping * (COMPRESSION_PER_SPACING / grid.spacing) ** 2) * pressure / density
    damping = pressure * (grid.damping * closing / implicit).clamp(min=-1)
    by_normal, by_director = by_normal + damping * d3, by_director + damping * normal

    reaction = by_normal.sum(-2) / points_per_triangle
    reaction = (reaction - dot(reaction, n) * n) / J  # n has unit length: only its tangential change is real
    energy_by_d3 = (area.unsqueeze(-2) / points_per_triangle) * by_director
    mass = _repeat_for_points(
        _select_active(candidates, model.areal_density * s.area, s.n) / points_per_triangle, points_per_triangle
    )
    position = _at_points(grid, candidates, state.x)
    scene = _repeat_for_points(candidates.scene, points_per_triangle)
    nodes = place_on_grid(position, mass, scene, grid, candidates.node_scratch, grid.shift(substep))
    return DirectorForces(
        cross(f2, reaction), cross(reaction, f1), energy_by_d3.flatten(0, 1), d3.flatten(0, 1), mass, nodes
    )


def add_director_stress(
    candidates: ContactCandidates, stress: tuple[Tensor, Tensor], directors: DirectorForces
) -> tuple[Tensor, Tensor]:
    """Add the directors' reaction to the columns [..., E, 3] N/m of the membrane stress."""
    first, second = (
        column.reshape(-1, 3).index_add(0, candidates.active, reaction).view(column.shape)
        for column, reaction in zip(stress, (directors.column1, directors.column2), strict=True)
    )
    return first, second


def contact_velocity_change(
    model: Model,
    grid: Grid,
    candidates: ContactCandidates,
    directors: DirectorForces,
    s: Surface,
    like: Tensor,
    dt: float,
) -> Tensor:
    """Compute by how much contact changes the vertices' velocities, [..., V, 3] m/s (the shape of ``like``).

    This is the exact transpose of how vertices carry velocity to the nodes, with the affine part. So linear and angular
    momentum are conserved to rounding, and contact is as symmetric as elasticity.
    """
    points_per_triangle = grid.points.shape[0]
    change, moment = transfer_director_forces(directors.nodes, directors.energy_by_d3, directors.d3, grid.spacing, dt)
    momentum = (directors.mass * change).unflatten(0, (-1, points_per_triangle))
    shares = torch.stack([(grid.points[:, corner, None] * momentum).sum(-2) for corner in range(3)])
    moments = (directors.mass.unsqueeze(-1) * moment).unflatten(0, (-1, points_per_triangle)).sum(1)
    shares = shares + _affine_shares(model, candidates, s, moments)
    total = torch.zeros_like(like).reshape(-1, 3).index_add(0, candidates.vertices.flatten(), shares.flatten(0, 1))
    return total.view(like.shape) / model.mass


def _affine_shares(model: Model, candidates: ContactCandidates, s: Surface, moment: Tensor) -> Tensor:
    """Return corner impulses [3, A, 3] N s: the transpose of ``_mesh_velocity_gradient``, of a moment [A, 3, 3]."""
    n, J, dual1, dual2 = (_select_active(candidates, field, s.n) for field in (s.n, s.J, s.cofactor1, s.cofactor2))
    dual1, dual2 = dual1 / J, dual2 / J
    normal = matvec(moment, n)
    first = matvec(moment, dual1) - dot(normal, dual1) * n
    second = matvec(moment, dual2) - dot(normal, dual2) * n
    g = model.geometry
    warp, weft = ([_select_active(candidates, part, s.n) for part in pair] for pair in (g.warp, g.weft))
    b, c = (warp[k] * first + weft[k] * second for k in range(2))
    return torch.stack([-(b + c), b, c])


def advance_directors(
    model: Model,
    grid: Grid,
    candidates: ContactCandidates,
    directors: DirectorForces | None,
    before: Surface,
    v: Tensor,
    after: Surface,
    dt: float,
) -> tuple[Tensor, Tensor]:
    """Carry the directors along with the velocities of the cloth, and map them back to the friction cone.

    The velocities on the nodes are those of the cloth. Contact forces act on the nodes between layers at every substep
    anew; a director that followed them there would slowly forget its compression, and layers would sink into each other
    at a speed proportional to dt.

    Args:
        model: the model.
        grid: the contact grid.
        candidates: the active triangles. All other directors are set to the normals.
        directors: what ``compute_director_forces`` returned; None: no triangle is active.
        before: the surface at the start of the substep.
        v: [..., V, 3] m/s, velocities at the end.
        after: the surface at the end of the substep.
        dt: length of the substep [s].

    Returns:
        The directors [..., P, 3], and how fast they close, -dR33/dt [..., P, 1] 1/s.
    """
    points_per_triangle = grid.points.shape[0]
    d3 = after.n.repeat_interleave(points_per_triangle, dim=-2)
    closing = torch.zeros_like(d3[..., :1])
    if directors is None:
        return d3, closing
    affine = _mesh_velocity_gradient(model, v, before).flatten(-2)
    affine = _repeat_for_points(_select_active(candidates, affine, before.n).unflatten(-1, (3, 3)), points_per_triangle)
    velocity = _at_points(grid, candidates, v)
    gradient = velocity_gradient(directors.nodes, directors.mass, velocity, affine, grid.spacing)
    carried = directors.d3 + dt * (gradient @ directors.d3.unsqueeze(-1)).squeeze(-1)
    old_d3, new_d3 = (field.unflatten(0, (-1, points_per_triangle)) for field in (directors.d3, carried))
    old_n, n = (_select_active(candidates, field, field).unsqueeze(-2) for field in (before.n, after.n))
    height = dot(new_d3, n)
    coefficients, free = coefficients_per_point(model, candidates, before), grid.free_compression
    mapped = model.material.return_map(coefficients, n, new_d3 + free * n) - free * n
    mapped = torch.where(height > 1 - free, height.clamp(max=1) * n, mapped)
    rate = (dot(old_d3, old_n) - height) / dt
    return _replace_active(candidates, d3, mapped), _replace_active(candidates, closing, rate)


def director_energy(model: Model, grid: Grid, s: Surface, d3: Tensor) -> Tensor:
    """Compute the energy of all directors, [...] J."""
    points_per_triangle = grid.points.shape[0]
    c = type(model.coefficients)(*(k.unsqueeze(-2) for k in model.coefficients))
    n = s.n.unsqueeze(-2)
    density = model.material.director_energy(
        c, n, d3.unflatten(-2, (-1, points_per_triangle)) + grid.free_compression * n
    )
    return (s.area.unsqueeze(-2) / points_per_triangle * density).sum((-3, -2, -1))


def coefficients_per_point(model: Model, candidates: ContactCandidates, s: Surface) -> Any:
    """Return the material's coefficients at the active triangles, with an axis for the contact points."""
    coefficients = model.coefficients
    return type(coefficients)(*(_select_active(candidates, c, s.n).unsqueeze(-2) for c in coefficients))


def _mesh_velocity_gradient(model: Model, v: Tensor, s: Surface) -> Tensor:
    """Return the velocity gradient [..., E, 3, 3] 1/s of a sheet whose normal turns with it; exact for rigid turns."""
    g = model.geometry
    v0, v1, v2 = corners(g, v)
    d1, d2 = v1 - v0, v2 - v0
    rate1 = g.warp[0] * d1 + g.warp[1] * d2
    rate2 = g.weft[0] * d1 + g.weft[1] * d2
    dual1, dual2 = s.cofactor1 / s.J, s.cofactor2 / s.J
    normal_rate = -(dot(rate1, s.n) * dual1 + dot(rate2, s.n) * dual2)
    left = torch.stack([rate1, rate2, normal_rate], dim=-1)
    right = torch.stack([dual1, dual2, s.n], dim=-1)
    return left @ right.mT


def _select_active(candidates: ContactCandidates, field: Tensor, like: Tensor) -> Tensor:
    """Return the rows [A, K] of a field [..., E or 1, K] at the active triangles; ``like`` is [..., E, 3]."""
    full = field.expand(*like.shape[:-1], field.shape[-1])
    return full.reshape(-1, field.shape[-1]).index_select(0, candidates.active)


def _replace_active(candidates: ContactCandidates, field: Tensor, rows: Tensor) -> Tensor:
    """Return the field [..., P, K] with the rows [A, S, K] of the active triangles replaced."""
    return field.reshape(-1, *rows.shape[1:]).index_copy(0, candidates.active, rows).view(field.shape)


def _repeat_for_points(rows: Tensor, points_per_triangle: int) -> Tensor:
    return rows.repeat_interleave(points_per_triangle, 0)


def _at_points(grid: Grid, candidates: ContactCandidates, field: Tensor) -> Tensor:
    """Return a vertex field [..., V, 3] at the contact points of the active triangles, [A S, 3]."""
    at_corners = field.reshape(-1, 3).index_select(0, candidates.vertices.flatten()).unflatten(0, (3, -1))
    return torch.einsum("sc,cak->ask", grid.points, at_corners).flatten(0, 1)
