"""Values between a mesh's vertices, as a matrix, exact where they are a quadratic function of the pattern.

Linear interpolation lies on a bent cloth's chords: carried half an edge on and back, a vertex would be off by more than
what a patch found elsewhere changes, and by as much in either direction. With the gradients G of the corners and the
offsets d of the place from them, sum w (x + G d / 2) has no such error (Taylor's series from each corner).
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ..meshes import Mesh
from .streams import on_pattern

SLIGHT = 1e-9  # ridge, of unit neighbourhoods: four neighbours in a cross leave the mixed derivative open


def between(mesh: Mesh, uv: np.ndarray) -> Tensor:
    """[N, V] weights of the vertices in values at pattern points [N, 2] m.

    Raises:
        InvalidInput: a point that is not on the pattern, or a mesh without pattern coordinates.
    """
    own: np.ndarray = mesh.uv  # type: ignore[assignment]
    hits = on_pattern(mesh, uv)
    corners, weights = hits.corners.numpy(), hits.weights.double().numpy()
    gradients = _gradients(own, _near(mesh.faces, len(own)))
    out = np.zeros((len(uv), len(own)))
    for corner, weight in zip(corners.T, weights.T, strict=True):
        out[np.arange(len(uv)), corner] += weight
        out += 0.5 * weight[:, None] * np.einsum("nc,ncv->nv", uv - own[corner], gradients[corner])
    return torch.as_tensor(out)


def _near(faces: np.ndarray, count: int) -> np.ndarray:
    """[V, V] bool: neighbours and theirs."""
    next_to = np.zeros((count, count), bool)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        next_to[faces[:, a], faces[:, b]] = next_to[faces[:, b], faces[:, a]] = True
    near = next_to | (next_to.astype(np.float32) @ next_to.astype(np.float32) > 0)
    np.fill_diagonal(near, False)
    return near


def _gradients(uv: np.ndarray, near: np.ndarray) -> np.ndarray:
    """[V, 2, V] 1/m: of a quadratic through each vertex that fits those near it, nearer ones more."""
    offset = uv[None] - uv[:, None]
    size = np.sqrt((near[..., None] * offset**2).sum((1, 2)) / near.sum(1))
    u, v = np.moveaxis(offset / size[:, None, None], -1, 0)
    weight = near / np.maximum(u**2 + v**2, 1e-12) ** 2
    basis = np.stack([u, v, u * u, u * v, v * v], 1)  # [V, 5, V]
    weighted = basis * weight[:, None]
    normal = weighted @ basis.transpose(0, 2, 1)
    normal += SLIGHT * normal.trace(axis1=1, axis2=2)[:, None, None] * np.eye(5)
    found = np.linalg.solve(normal, weighted)[:, :2] / size[:, None, None]
    itself = np.arange(len(uv))
    found[itself, :, itself] -= found.sum(2)
    return found
