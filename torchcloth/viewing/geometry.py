"""Triangles, rotations and times, in numpy."""

from __future__ import annotations

import numpy as np

Array = np.ndarray


def edges_of(faces: Array) -> Array:
    """[E, 2] vertices of the edges of triangles [F, 3], each once."""
    return np.unique(np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)


def hems_of(faces: Array) -> Array:
    """[E, 2] vertices of the edges that only one of the triangles [F, 3] has."""
    edges, count = np.unique(
        np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0, return_counts=True
    )
    return edges[count == 1]


def face_normals(x: Array, faces: Array) -> Array:
    """[F, 3] unit normals of triangles."""
    a, b, c = x[faces[:, 0]], x[faces[:, 1]], x[faces[:, 2]]
    return unit(np.cross(b - a, c - a))


def soft_normals(x: Array, faces: Array) -> Array:
    """[F, 3] unit normals of triangles, drawn towards those around where these agree: a seam stays an edge."""
    a, b, c = x[faces[:, 0]], x[faces[:, 1]], x[faces[:, 2]]
    own = np.cross(b - a, c - a)
    size = np.linalg.norm(own, axis=-1)
    total, weight = np.zeros_like(x), np.zeros(len(x))
    np.add.at(total, faces, own[:, None])
    np.add.at(weight, faces, size[:, None])
    agreed = total / np.maximum(weight, 1e-12)[:, None]  # short where normals cancel
    return unit(agreed[faces].sum(1) + unit(own))


def nearest(times: Array, wanted: Array) -> Array:
    """[N] index into ``times`` [K], increasing, of the entry nearest to each of ``wanted`` [N]."""
    after = np.clip(np.searchsorted(times, wanted), 1, max(1, len(times) - 1))
    before = after - 1
    after = np.minimum(after, len(times) - 1)
    return np.where(wanted - times[before] <= times[after] - wanted, before, after)


def quaternions(rotations: Array) -> Array:
    """[N, 4] unit quaternions wxyz of rotations [N, 3, 3], of which each is the nearer one to that before it.

    The eigenvector of the largest eigenvalue (Bar-Itzhack, J. Guidance 23, 2000): no case needs care.
    """
    (a, b, c), (d, e, f), (g, h, i) = np.moveaxis(rotations, 0, -1)
    rows = [
        [a + e + i, h - f, c - g, d - b],
        [h - f, a - e - i, b + d, c + g],
        [c - g, b + d, e - a - i, f + h],
        [d - b, c + g, f + h, i - a - e],
    ]
    q = np.linalg.eigh(np.moveaxis(np.array(rows), -1, 0))[1][:, :, -1]
    turns = np.append(q[0, 0], (q[1:] * q[:-1]).sum(-1))  # the first has its real part positive
    return q * np.cumprod(np.where(turns < 0, -1.0, 1.0))[:, None]


def unit(v: Array) -> Array:
    """Vectors [..., 3] at length one; zero stays zero."""
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12)
