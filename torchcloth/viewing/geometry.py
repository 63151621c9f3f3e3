"""Geometry of triangles, rotations and time grids in numpy."""

from __future__ import annotations

import numpy as np

Array = np.ndarray


def unique_edges(faces: Array) -> Array:
    """Return the edges [E, 2] of triangles [F, 3], each once."""
    return np.unique(np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)


def boundary_edges(faces: Array) -> Array:
    """Return the edges [E, 2] that belong to only one of the triangles [F, 3]."""
    edges, count = np.unique(
        np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0, return_counts=True
    )
    return edges[count == 1]


def face_normals(x: Array, faces: Array) -> Array:
    """Return the unit normals [F, 3] of triangles."""
    a, b, c = x[faces[:, 0]], x[faces[:, 1]], x[faces[:, 2]]
    return normalise(np.cross(b - a, c - a))


def smoothed_normals(x: Array, faces: Array) -> Array:
    """Return unit normals [F, 3] of triangles, smoothed where adjacent normals agree; seams stay sharp."""
    a, b, c = x[faces[:, 0]], x[faces[:, 1]], x[faces[:, 2]]
    area_vectors = np.cross(b - a, c - a)
    area = np.linalg.norm(area_vectors, axis=-1)
    total, weight = np.zeros_like(x), np.zeros(len(x))
    np.add.at(total, faces, area_vectors[:, None])
    np.add.at(weight, faces, area[:, None])
    vertex_mean = total / np.maximum(weight, 1e-12)[:, None]  # short where normals cancel
    return normalise(vertex_mean[faces].sum(1) + normalise(area_vectors))


def nearest_indices(times: Array, wanted: Array) -> Array:
    """Return [N] the index of the entry of ``times`` [K], increasing, that is nearest to each of ``wanted`` [N]."""
    after = np.clip(np.searchsorted(times, wanted), 1, max(1, len(times) - 1))
    before = after - 1
    after = np.minimum(after, len(times) - 1)
    return np.where(wanted - times[before] <= times[after] - wanted, before, after)


def to_quaternions(rotations: Array) -> Array:
    """Convert rotations [N, 3, 3] to unit quaternions wxyz [N, 4] with continuous signs.

    The quaternion is the eigenvector of the largest eigenvalue (Bar-Itzhack, J. Guidance 23, 2000), which has no
    special cases.
    """
    (a, b, c), (d, e, f), (g, h, i) = np.moveaxis(rotations, 0, -1)
    rows = [
        [a + e + i, h - f, c - g, d - b],
        [h - f, a - e - i, b + d, c + g],
        [c - g, b + d, e - a - i, f + h],
        [d - b, c + g, f + h, i - a - e],
    ]
    q = np.linalg.eigh(np.moveaxis(np.array(rows), -1, 0))[1][:, :, -1]
    alignment = np.append(q[0, 0], (q[1:] * q[:-1]).sum(-1))  # the first one gets a positive real part
    return q * np.cumprod(np.where(alignment < 0, -1.0, 1.0))[:, None]


def normalise(v: Array) -> Array:
    """Return vectors [..., 3] with length one; zero stays zero."""
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12)
