"""Interpolation between a mesh's vertices, exact for quadratic functions of the pattern.

Linear interpolation lies on the chords of a bent cloth. Interpolated by half an edge and back, a vertex would be off by
more than the change that a slightly moved patch causes, in either direction. With the gradients G at the corners and
the offsets d of the place from them, sum w (x + G d / 2) has no such error (Taylor's series from each corner).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ..meshes import Mesh, topology
from ..meshes.patches import Patch, fit_to_patches
from .streams import locate_on_pattern

RELATIVE_RIDGE = 1e-9  # of unit neighbourhoods: four neighbours in a cross leave the mixed derivative open
AT_VERTEX_TOLERANCE_M = 1e-9  # distance within which a place is a vertex


def interpolation_weights(mesh: Mesh, uv: np.ndarray) -> Tensor:
    """Return weights [N, V] (sparse) of the vertices in values at pattern points.

    Args:
        mesh: with pattern coordinates.
        uv: [N, 2] m, pattern points.

    Raises:
        InvalidInput: a point that is not on the pattern, or a mesh without pattern coordinates.
    """
    vertex_uv: np.ndarray = mesh.uv  # type: ignore[assignment] - locate_on_pattern refuses a mesh without
    hits = locate_on_pattern(mesh, uv)
    corners, weights = hits.corners.numpy(), hits.weights.double().numpy()
    points = np.repeat(np.arange(len(uv)), 3)
    needs_gradient = (weights * np.linalg.norm(uv[:, None] - vertex_uv[corners], axis=-1)).ravel()
    needs_gradient = needs_gradient > AT_VERTEX_TOLERANCE_M
    used, index = np.unique(corners.ravel()[needs_gradient], return_inverse=True)
    neighbours = _two_rings(mesh.faces, used)
    gradients = _gradient_weights(vertex_uv, neighbours)
    offset = (uv[points] - vertex_uv[corners.ravel()])[needs_gradient]
    along_gradient = np.einsum("nc,nck->nk", offset, gradients[index])
    correction = 0.5 * weights.ravel()[needs_gradient, None] * along_gradient
    rows = np.concatenate([points, np.repeat(points[needs_gradient], neighbours.shape[1])])
    columns = np.concatenate([corners.ravel(), neighbours[index].ravel()])
    values = np.concatenate([weights.ravel(), correction.ravel()])
    indices = torch.as_tensor(np.stack([rows, columns]))
    size = len(uv), len(vertex_uv)
    return torch.sparse_coo_tensor(indices, torch.as_tensor(values), size, check_invariants=True).coalesce()


def interpolate_on_pattern(weights: Tensor, x: Tensor) -> Tensor:
    """Interpolate values [..., V, C] with the weights [N, V] of ``interpolation_weights``; returns [..., N, C]."""
    flat = x.movedim(-2, 0)
    out = torch.sparse.mm(weights.to(x), flat.reshape(len(flat), -1))
    return out.reshape(len(weights), *flat.shape[1:]).movedim(0, -2)


def move_vertices_to_patches(mesh: Mesh, patches: Sequence[Patch]) -> Mesh:
    """Return the same cloth and triangles with vertices at the edges of patches; unchanged without a pattern."""
    if mesh.uv is None:
        return mesh
    uv = fit_to_patches(mesh, patches)
    if np.array_equal(uv, mesh.uv):
        return mesh
    vertices = interpolate_on_pattern(interpolation_weights(mesh, uv), torch.as_tensor(mesh.vertices)).numpy()
    return Mesh.build(vertices, mesh.faces, uv, mesh.places)


def _two_rings(faces: np.ndarray, used: np.ndarray) -> np.ndarray:
    """[S, K] the used vertices, their neighbours and those of these; where there are fewer, the vertex again."""
    ends, _ = topology.find_edges(faces)
    pairs = np.unique(np.concatenate([ends, ends[:, ::-1]]), axis=0)
    first = np.searchsorted(pairs[:, 0], np.arange(faces.max() + 1))
    place = np.arange(len(pairs)) - first[pairs[:, 0]]
    ring = np.tile(np.arange(len(first))[:, None], (1, place.max() + 1))
    ring[pairs[:, 0], place] = pairs[:, 1]
    return np.concatenate([used[:, None], ring[used], ring[ring[used]].reshape(len(used), ring.shape[1] ** 2)], 1)


def _gradient_weights(uv: np.ndarray, neighbours: np.ndarray) -> np.ndarray:
    """[S, 2, K] 1/m: gradient of a quadratic through the first vertex that fits the others, nearer ones more."""
    offset, is_other = uv[neighbours] - uv[neighbours[:, :1]], neighbours != neighbours[:, :1]
    size = np.sqrt((offset**2).sum((1, 2)) / is_other.sum(1))
    u, v = np.moveaxis(offset / size[:, None, None], -1, 0)
    weight = is_other / np.maximum(u**2 + v**2, 1e-12) ** 2
    basis = np.stack([u, v, u * u, u * v, v * v], 1)  # [S, 5, K]
    weighted = basis * weight[:, None]
    normal = weighted @ basis.transpose(0, 2, 1)
    normal += RELATIVE_RIDGE * normal.trace(axis1=1, axis2=2)[:, None, None] * np.eye(5)
    gradient = np.linalg.solve(normal, weighted)[:, :2] / size[:, None, None]
    gradient[:, :, 0] = -gradient.sum(2)  # the vertex itself comes first
    return gradient
