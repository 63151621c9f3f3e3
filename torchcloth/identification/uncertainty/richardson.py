"""The same cloth on a mesh twice as fine, and what that changes in a fit: numerics, no physics.

A sheet of coarse triangles does not bend and wrinkle as the cloth does. What a fit makes up for that in its parameters
is found from one simulation on the finer mesh: with residuals r and r' of the two meshes at the solution, it asks for
the step d = -(J' W J + P)^-1 J' W (r' - r). Errors fall with the square of the edges, so the limit is 4/3 d away, and a
third of d is added to the standard errors for what the extrapolation leaves open.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from ...boundaries import AbstractBoundary, Grasp
from ...cloth import Cloth
from ...episodes.observed import episode, on_mesh
from ...episodes.pattern_interpolation import between, carried, with_patches
from ...errors import InvalidInput
from ...meshes import Mesh
from ...meshes.patches import Patch
from ...parameters import PhysicalParameter
from ...recordings import Recording
from ...simulation.bound_modules import loose
from ..estimators import levenberg_marquardt
from ..estimators.objective import Objective

LIMIT, OPEN = 4 / 3, 1 / 3  # of the step between two meshes, whose edges are as 2 to 1


def finer_cloth(cloth: Cloth) -> Cloth:
    """With every triangle divided into four; grippers hold what they held.

    Raises:
        InvalidInput: a parameter with one value per triangle or vertex.
    """
    places = len(cloth.mesh.faces), len(cloth.mesh.vertices)
    for name, part in cloth.named_modules():
        if isinstance(part, PhysicalParameter) and any(size in places for size in part.raw.shape[-2:]):
            expected = "one number for all triangles"
            raise InvalidInput(f"a finer mesh: {name}", got=f"shape {tuple(part.raw.shape)}", expected=expected)
    mesh, kept = cloth.mesh, loose(cloth)
    ends, _ = _divided(mesh.faces)
    fine = _divided_mesh(mesh)
    parts = kept.boundaries.items()
    patches = {name: _patch(part, mesh) for name, part in parts}
    fine = with_patches(fine, [p for p in patches.values() if p])  # rounder than the coarse mesh has them
    boundaries = {name: part if patches[name] else _regripped(part, ends, mesh) for name, part in parts}
    grid, contact = cloth.grid(), cloth.contact  # a gap is no numerics
    contact = contact and replace(contact, spacing=None if grid is None else grid.spacing)
    return Cloth(
        fine,
        kept.material,
        kept.areal_density,
        kept.effects,
        boundaries,
        contact,
        cloth.engine,
    )


def finer_recording(recording: Recording, coarse: Mesh, fine: Mesh) -> Recording:
    """The episode for the finer mesh of ``finer_cloth``: its first shape has the new vertices between the others."""
    first = recording.cloth.initial_vertices
    if first is not None and first.ndim == 2:  # else a sheet's grid
        first = _between(on_mesh(coarse, recording, torch.as_tensor(first)).numpy(), _divided(coarse.faces)[0])
        if fine.uv is not None:
            first = carried(between(_divided_mesh(coarse), fine.uv), torch.as_tensor(first)).numpy()
    info = replace(recording.cloth, vertices=fine.vertices, faces=fine.faces, uv=fine.uv, initial_vertices=first)
    return replace(recording, cloth=info)


def mesh_step(objective: Objective, final: levenberg_marquardt.Iterate, recordings: Sequence[Recording]) -> Tensor:
    """[K], the step that a mesh twice as fine asks for at the solution; unconstrained coordinates."""
    coarse = objective.cloth
    cloth = finer_cloth(coarse)
    episodes = [
        episode(cloth, finer_recording(r, coarse.mesh, cloth.mesh)).beyond(e.lookahead)
        for r, e in zip(recordings, objective.episodes, strict=True)
    ]
    fine = Objective(
        cloth, objective.unknowns, episodes, objective.dt, objective.nuisances, objective.blocks, objective.floors
    )
    rows, linear = fine.evaluate_all(final.raw), final.linear
    changed = torch.zeros_like(linear.value)
    for b in linear.kind.unique():
        own, other = linear.kind == b, rows.kind == b
        if int(own.sum()) == int(other.sum()):  # along the rim other points may count: it is left as it is
            before, after = linear.value[own], rows.value[other]
            changed[own] = torch.where((before == 0) | (after == 0), 0.0, after - before)  # 0: a piece not seen
    weighted = final.influence()[0][:, None] * linear.jacobian
    return -torch.linalg.solve(levenberg_marquardt.information(objective.problem(), final), weighted.mT @ changed)


def _divided_mesh(mesh: Mesh) -> Mesh:
    ends, faces = _divided(mesh.faces)
    pattern = None if mesh.pattern is None else _quartered(mesh.pattern)
    return Mesh.build(_between(mesh.vertices, ends), faces, pattern, mesh.places)


def _patch(part: AbstractBoundary, mesh: Mesh) -> Patch | None:
    """What it holds, where the mesh has vertices on the edge of that."""
    if not isinstance(part, Grasp) or part.uv is None or mesh.uv is None:
        return None
    patch = Patch(part.uv, part.radius)
    return patch if patch.ends_on(mesh.uv) else None


def _regripped(part: AbstractBoundary, ends: np.ndarray, mesh: Mesh) -> AbstractBoundary:
    """A grasp holds the new vertices between those that were held, too: by its radius it would hold more, or less."""
    if not isinstance(part, Grasp):
        return part
    between = len(mesh.vertices) + np.flatnonzero(np.isin(ends, part.index.cpu().numpy()).all(1))
    return part.holding(torch.cat([part.index, torch.as_tensor(between).to(part.index)]))


def _between(field: np.ndarray, ends: np.ndarray) -> np.ndarray:
    return np.concatenate([field, 0.5 * (field[ends[:, 0]] + field[ends[:, 1]])])


def _quartered(corners: np.ndarray) -> np.ndarray:
    """[4 F, 3, 2] of the triangles of ``_divided`` from [F, 3, 2]; along a seam each panel has its own."""
    i, j, k = corners.transpose(1, 0, 2)
    return _four((i, j, k), ((j + k) / 2, (k + i) / 2, (i + j) / 2))


def _divided(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(vertex pairs [N, 2] with a new vertex between, faces [4 F, 3])."""
    sides = np.sort(faces[:, [1, 2, 2, 0, 0, 1]].reshape(-1, 2), axis=1)
    ends, index = np.unique(sides, axis=0, return_inverse=True)
    return ends, _four(faces.T, (index.reshape(-1, 3) + faces.max() + 1).T)


def _four(corners: Iterable[np.ndarray], middles: Iterable[np.ndarray]) -> np.ndarray:
    """[4 F, 3, ...], the parts of every triangle, from its corners and what is halfway opposite to each, [F, ...]."""
    (i, j, k), (a, b, c) = corners, middles
    return np.concatenate([np.stack(t, 1) for t in ((i, c, b), (c, j, a), (b, a, k), (a, b, c))])
