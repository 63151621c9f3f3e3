"""Which triangles meet along which edges, in the mesh and on the pattern."""

from __future__ import annotations

import numpy as np


def find_edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find the edges [N, 2] of faces [F, 3], lower vertex first; return them and how many triangles each has [N]."""
    return np.unique(np.sort(_sides(faces), axis=1), axis=0, return_counts=True)


def find_inconsistent_sides(faces: np.ndarray) -> np.ndarray:
    """Find sides [N, 2] that several triangles have in the same direction: of opposite winding, or more than two."""
    sides, counts = np.unique(_sides(faces), axis=0, return_counts=True)
    return sides[counts > 1]


def find_seams(faces: np.ndarray, pattern: np.ndarray) -> np.ndarray:
    """Find the edges [N, 2] at which panels are sewn: their triangles lie apart on the pattern [F, 3, 2] m."""
    pairs = np.unique(_laid_sides(faces, pattern), axis=0)[:, :2]
    once, laid = np.unique(pairs, axis=0, return_counts=True)
    return once[laid > 1].astype(np.int64)


def number_panels(faces: np.ndarray, pattern: np.ndarray) -> np.ndarray:
    """Number the panels, and return each triangle's [F]: triangles that are joined on the pattern without a seam."""
    _, side = np.unique(_laid_sides(faces, pattern), axis=0, return_inverse=True)
    return _joined(side.reshape(-1, 3))


def count_pieces(faces: np.ndarray) -> int:
    """Count the pieces that have no vertex in common."""
    return int(_joined(faces).max()) + 1


def number_pieces(faces: np.ndarray) -> np.ndarray:
    """Number the pieces from 0, and return each vertex's [V]; 0 for vertices in no triangle."""
    out = np.zeros(int(faces.max(initial=-1)) + 1, np.int64)
    out[faces.ravel()] = np.repeat(_joined(faces), 3)
    return out


def find_first_vertices(faces: np.ndarray) -> np.ndarray:
    """Return one vertex of each piece, [pieces]."""
    return faces[np.unique(_joined(faces), return_index=True)[1], 0]


def _joined(touched: np.ndarray) -> np.ndarray:
    """Return component numbers [F] from 0 of triangles that are joined by what they touch [F, 3]."""
    label = np.arange(len(touched))
    while True:
        lowest = np.full(touched.max() + 1, len(touched))
        np.minimum.at(lowest, touched.ravel(), np.repeat(label, 3))
        lowered = lowest[touched].min(1)
        lowered = lowered[lowered]  # the label of the label: paths are halved
        if np.array_equal(lowered, label):
            return np.unique(label, return_inverse=True)[1]
        label = lowered


def find_farthest_vertex(faces: np.ndarray, rest: np.ndarray, start: int) -> tuple[int, float]:
    """Find the vertex of the piece farthest from ``start`` along rest edges; return it and its distance [m]."""
    ends = _sides(faces)
    length = np.linalg.norm(rest[:, [1, 2, 0]] - rest, axis=-1).ravel()
    distance = np.full(faces.max() + 1, np.inf)
    distance[start] = 0.0
    while True:
        nearer = distance.copy()
        for a, b in ((0, 1), (1, 0)):
            np.minimum.at(nearer, ends[:, b], distance[ends[:, a]] + length)
        if np.array_equal(nearer, distance):
            break
        distance = nearer
    distance[np.isinf(distance)] = -1.0
    return int(distance.argmax()), float(distance.max())


def _sides(faces: np.ndarray) -> np.ndarray:
    """Return the sides of every triangle in its direction, [3 F, 2]."""
    return faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)


def _laid_sides(faces: np.ndarray, pattern: np.ndarray) -> np.ndarray:
    """Return for each side lower vertex, higher vertex, and the pattern coordinates of both, [3 F, 6]."""
    sides, ends = _sides(faces), pattern[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2, 2)
    order = np.argsort(sides, axis=1)
    ends = np.take_along_axis(ends, order[..., None], axis=1).reshape(-1, 4)
    return np.column_stack([np.take_along_axis(sides, order, axis=1), ends])
