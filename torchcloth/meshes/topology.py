"""Which triangles meet along which edges, in the world and on the pattern."""

from __future__ import annotations

import numpy as np


def find_edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(edges [N, 2] with the lower vertex first, triangles at each [N]) of faces [F, 3]."""
    return np.unique(np.sort(_sides(faces), axis=1), axis=0, return_counts=True)


def find_inconsistent_sides(faces: np.ndarray) -> np.ndarray:
    """Sides [N, 2] that several triangles run along in one direction: they turn unlike, or are more than two."""
    sides, times = np.unique(_sides(faces), axis=0, return_counts=True)
    return sides[times > 1]


def find_seams(faces: np.ndarray, pattern: np.ndarray) -> np.ndarray:
    """Edges [N, 2] whose triangles lie apart on the pattern [F, 3, 2] m: there, two panels are sewn."""
    pairs = np.unique(_laid_sides(faces, pattern), axis=0)[:, :2]
    once, laid = np.unique(pairs, axis=0, return_counts=True)
    return once[laid > 1].astype(np.int64)


def number_panels(faces: np.ndarray, pattern: np.ndarray) -> np.ndarray:
    """[F] number of the panel of each triangle: those that are joined on the pattern, without crossing a seam."""
    _, side = np.unique(_laid_sides(faces, pattern), axis=0, return_inverse=True)
    return _joined(side.reshape(-1, 3))


def count_pieces(faces: np.ndarray) -> int:
    """How many parts have no vertex in common."""
    return int(_joined(faces).max()) + 1


def number_pieces(faces: np.ndarray) -> np.ndarray:
    """[V] the part of each vertex of a triangle, numbers from 0 on; 0 for others."""
    out = np.zeros(int(faces.max(initial=-1)) + 1, np.int64)
    out[faces.ravel()] = np.repeat(_joined(faces), 3)
    return out


def find_first_vertices(faces: np.ndarray) -> np.ndarray:
    """[pieces] a vertex of each."""
    return faces[np.unique(_joined(faces), return_index=True)[1], 0]


def _joined(touched: np.ndarray) -> np.ndarray:
    """[F] numbers from 0 on of triangles that are joined by what they touch [F, 3]."""
    label = np.arange(len(touched))
    while True:
        lowest = np.full(touched.max() + 1, len(touched))
        np.minimum.at(lowest, touched.ravel(), np.repeat(label, 3))
        spread = lowest[touched].min(1)
        spread = spread[spread]  # a label's own label: paths are halved
        if np.array_equal(spread, label):
            return np.unique(label, return_inverse=True)[1]
        label = spread


def find_farthest_vertex(faces: np.ndarray, rest: np.ndarray, start: int) -> tuple[int, float]:
    """(vertex, m): the one farthest from ``start`` along the edges of the rest shape, and how far; within its piece."""
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
    """[3 F, 2] the sides of every triangle, in its own direction."""
    return faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)


def _laid_sides(faces: np.ndarray, pattern: np.ndarray) -> np.ndarray:
    """[3 F, 6] lower vertex, higher vertex, and the pattern coordinates of both."""
    sides, ends = _sides(faces), pattern[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2, 2)
    order = np.argsort(sides, axis=1)
    ends = np.take_along_axis(ends, order[..., None], axis=1).reshape(-1, 4)
    return np.column_stack([np.take_along_axis(sides, order, axis=1), ends])
