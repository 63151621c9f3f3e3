"""Values between a mesh's vertices, exact where they are a quadratic function of the pattern.

Linear interpolation lies on a bent cloth's chords: carried half an edge on and back, a vertex would be off by more than
what a patch found elsewhere changes, and by as much in either direction. With the gradients G of the corners and the
offsets d of the place from them, sum w (x + G d / 2) has no such error (Taylor's series from each corner).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ..meshes import Mesh, topology
from ..meshes.patches import Patch, fitted_to
from .streams import on_pattern

SLIGHT = 1e-9  # ridge, of unit neighbourhoods: four neighbours in a cross leave the mixed derivative open
THERE = 1e-9  # m, within which a place is a vertex


def between(mesh: Mesh, uv: np.ndarray) -> Tensor:
    """[N, V] sparse, weights of the vertices in values at pattern points [N, 2] m.

    Raises:
        InvalidInput: a point that is not on the pattern, or a mesh without pattern coordinates.
    """
    own: np.ndarray = mesh.uv  # type: ignore[assignment]
    hits = on_pattern(mesh, uv)
    corners, weights = hits.corners.numpy(), hits.weights.double().numpy()
    points = np.repeat(np.arange(len(uv)), 3)
    bent = (weights * np.linalg.norm(uv[:, None] - own[corners], axis=-1)).ravel() > THERE
    used, which = np.unique(corners.ravel()[bent], return_inverse=True)
    near = _two_rings(mesh.faces, used)
    gradients = _gradients(own, near)
    offset = (uv[points] - own[corners.ravel()])[bent]
    share = 0.5 * weights.ravel()[bent, None] * np.einsum("nc,nck->nk", offset, gradients[which])
    rows = np.concatenate([points, np.repeat(points[bent], near.shape[1])])
    columns = np.concatenate([corners.ravel(), near[which].ravel()])
    values = np.concatenate([weights.ravel(), share.ravel()])
    index = torch.as_tensor(np.stack([rows, columns]))
    size = len(uv), len(own)
    return torch.sparse_coo_tensor(index, torch.as_tensor(values), size, check_invariants=True).coalesce()


def carried(weights: Tensor, x: Tensor) -> Tensor:
    """[..., N, C], by the weights [N, V] of ``between``, of values [..., V, C]."""
    flat = x.movedim(-2, 0)
    out = torch.sparse.mm(weights.to(x), flat.reshape(len(flat), -1))
    return out.reshape(len(weights), *flat.shape[1:]).movedim(0, -2)


def with_patches(mesh: Mesh, patches: Sequence[Patch]) -> Mesh:
    """The same cloth and triangles, with vertices where patches end; as it is without pattern coordinates."""
    if mesh.uv is None:
        return mesh
    uv = fitted_to(mesh, patches)
    if np.array_equal(uv, mesh.uv):
        return mesh
    vertices = carried(between(mesh, uv), torch.as_tensor(mesh.vertices)).numpy()
    return Mesh.build(vertices, mesh.faces, uv, mesh.places)


def _two_rings(faces: np.ndarray, used: np.ndarray) -> np.ndarray:
    """[S, K] of the vertices used: themselves, neighbours and theirs; themselves again where there are fewer."""
    ends, _ = topology.edges(faces)
    pairs = np.unique(np.concatenate([ends, ends[:, ::-1]]), axis=0)
    first = np.searchsorted(pairs[:, 0], np.arange(faces.max() + 1))
    place = np.arange(len(pairs)) - first[pairs[:, 0]]
    ring = np.tile(np.arange(len(first))[:, None], (1, place.max() + 1))
    ring[pairs[:, 0], place] = pairs[:, 1]
    return np.concatenate([used[:, None], ring[used], ring[ring[used]].reshape(len(used), ring.shape[1] ** 2)], 1)


def _gradients(uv: np.ndarray, near: np.ndarray) -> np.ndarray:
    """[S, 2, K] 1/m: of a quadratic through the first of the vertices [S, K] that fits the others, nearer ones more."""
    offset, other = uv[near] - uv[near[:, :1]], near != near[:, :1]
    size = np.sqrt((offset**2).sum((1, 2)) / other.sum(1))
    u, v = np.moveaxis(offset / size[:, None, None], -1, 0)
    weight = other / np.maximum(u**2 + v**2, 1e-12) ** 2
    basis = np.stack([u, v, u * u, u * v, v * v], 1)  # [S, 5, K]
    weighted = basis * weight[:, None]
    normal = weighted @ basis.transpose(0, 2, 1)
    normal += SLIGHT * normal.trace(axis1=1, axis2=2)[:, None, None] * np.eye(5)
    found = np.linalg.solve(normal, weighted)[:, :2] / size[:, None, None]
    found[:, :, 0] = -found.sum(2)  # the vertex itself comes first
    return found
