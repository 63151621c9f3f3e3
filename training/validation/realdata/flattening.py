"""Opens a sewn garment into one flat piece: cuts along edges, then a nearly isometric map into the plane.

A recording's mesh has one pattern coordinate per vertex, which a closed garment cannot have: it needs seams where it
is open. Cutting doubles the vertices on a seam; nothing sews them together afterwards.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra

Edge = tuple[int, int]
LEAST_WEIGHT = 0.2  # of an edge in the flattening: obtuse slivers have negative cotangents, which fold the map


class Flat(NamedTuple):
    """A mesh in the plane."""

    uv: np.ndarray  # [V, 2] m
    stretch: np.ndarray  # [F, 2] singular values of the map from the triangle in space to the plane
    flipped: int  # triangles with no positive area


def edges_of(faces: np.ndarray) -> dict[Edge, list[int]]:
    """Edge (low, high) -> its faces."""
    out: dict[Edge, list[int]] = defaultdict(list)
    for f, (a, b, c) in enumerate(faces.tolist()):
        for i, j in ((a, b), (b, c), (c, a)):
            out[min(i, j), max(i, j)].append(f)
    return out


def boundary_loops(faces: np.ndarray) -> list[np.ndarray]:
    """Vertices of every boundary, longest first."""
    pairs = np.array([edge for edge, owners in edges_of(faces).items() if len(owners) == 1])
    size = int(faces.max()) + 1
    label = connected_components(_matrix(np.ones(len(pairs)), pairs, size))[1]
    used = np.unique(pairs)
    loops = [used[label[used] == k] for k in np.unique(label[used])]
    return sorted(loops, key=len, reverse=True)


def shortest_path(vertices: np.ndarray, faces: np.ndarray, start: np.ndarray, end: np.ndarray) -> list[Edge]:
    """Edges of the shortest way from any vertex of ``start`` to any of ``end``."""
    distance, before, _ = dijkstra(_lengths(vertices, faces), indices=start, return_predecessors=True, min_only=True)
    way = [int(end[np.argmin(distance[end])])]
    while before[way[-1]] >= 0:
        way.append(int(before[way[-1]]))
    return [(min(e), max(e)) for e in pairwise(way)]


def cut(faces: np.ndarray, along: Iterable[Edge]) -> tuple[np.ndarray, np.ndarray]:
    """Open a mesh along edges, and drop all but its largest component.

    Returns:
        (faces [F', 3] of the new mesh, [V'] the old vertex of each new one)
    """
    closed = set(along)
    pairs = [
        (3 * owners[0] + _place(faces, owners[0], v), 3 * other + _place(faces, other, v))
        for edge, owners in edges_of(faces).items()
        if edge not in closed
        for other in owners[1:]
        for v in edge
    ]
    corner = connected_components(_matrix(np.ones(len(pairs)), np.array(pairs), 3 * len(faces)))[1].reshape(-1, 3)
    ring = np.concatenate([corner[:, [0, 1]], corner[:, [1, 2]]])
    piece = connected_components(_matrix(np.ones(len(ring)), ring, int(corner.max()) + 1))[1][corner[:, 0]]
    kept = piece == np.bincount(piece).argmax()
    old, new = np.unique(corner[kept], return_inverse=True)
    source = np.zeros(int(corner.max()) + 1, dtype=np.int64)
    source[corner] = faces
    return new.reshape(-1, 3), source[old]


def flatten(vertices: np.ndarray, faces: np.ndarray, iterations: int = 500) -> Flat:
    """As-rigid-as-possible map of a disc into the plane (Liu et al. 2008), started from geodesic distances."""
    uv = _spread_out(vertices, faces)
    if area_of(uv[faces]).sum() < 0:
        uv = uv * [1.0, -1.0]
    rest = _in_own_plane(vertices[faces])
    opposite = [(1, 2), (2, 0), (0, 1)]
    weight = np.stack([_cotangent(rest, *_others(k)) for k in range(3)], axis=1)
    pairs = [faces[:, list(opposite[k])] for k in range(3)]
    spans = [rest[:, i] - rest[:, j] for i, j in opposite]
    inverse = np.linalg.pinv(_laplacian(pairs, weight, len(vertices)))
    for _ in range(iterations):
        moved = [uv[p[:, 0]] - uv[p[:, 1]] for p in pairs]
        spread = sum(weight[:, k, None, None] * moved[k][:, :, None] * spans[k][:, None, :] for k in range(3))
        turn = _rotations(spread)
        pull = np.zeros_like(uv)
        for k in range(3):
            wanted = weight[:, k, None] * np.einsum("fab,fb->fa", turn, spans[k])
            np.add.at(pull, pairs[k][:, 0], wanted)
            np.add.at(pull, pairs[k][:, 1], -wanted)
        before, uv = uv, inverse @ pull
        if np.abs(uv - before).max() < 1e-6:
            break
    flat = uv[faces]
    sides = np.stack([flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]], axis=-1)
    own = np.stack([rest[:, 1], rest[:, 2]], axis=-1)
    stretch = np.linalg.svd(sides @ np.linalg.inv(own), compute_uv=False)
    return Flat(uv, stretch, int((area_of(flat) <= 0).sum()))


def thicken(uv: np.ndarray, faces: np.ndarray, height: float) -> tuple[np.ndarray, np.ndarray]:
    """Collapse edges of slivers in the plane until no triangle is thinner than ``height`` [m], where that is possible.

    A vertex is merged into a neighbour; nothing else moves. A merge that would fold a triangle over or change the
    topology is skipped; vertices on the boundary move along it only.

    Returns:
        (faces [F', 3] of the new mesh, [V'] the old vertex of each new one)
    """
    faces = faces.copy()
    while (merge := _best_merge(uv, faces, height)) is not None:
        faces = merge
    old, new = np.unique(faces, return_inverse=True)
    return new.reshape(-1, 3), old


def heights_of(corners: np.ndarray) -> np.ndarray:
    """Smallest heights [F] m of plane triangles [F, 3, 2]."""
    return 2 * area_of(corners) / np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).max(1)


def _best_merge(uv: np.ndarray, faces: np.ndarray, height: float) -> np.ndarray | None:
    """Faces after the first merge that thickens one of the thin triangles, thinnest first; None when there is none."""
    heights = heights_of(uv[faces])
    edges = edges_of(faces)
    outline = {v for edge, owners in edges.items() if len(owners) == 1 for v in edge}
    for f in np.flatnonzero(heights < height)[np.argsort(heights[heights < height])]:
        ring = [(int(faces[f, i]), int(faces[f, j])) for i, j in ((0, 1), (1, 2), (2, 0))]
        ways = sorted([*ring, *((b, a) for a, b in ring)], key=lambda way: np.linalg.norm(uv[way[0]] - uv[way[1]]))
        for gone, into in ways:
            owners = edges[min(gone, into), max(gone, into)]
            if gone in outline and len(owners) == 2:
                continue
            around = faces[(faces == gone).any(1)]
            if len(np.intersect1d(around, faces[(faces == into).any(1)])) != 2 + len(owners):
                continue  # they share more neighbours than the triangles between them
            changed = np.where(around == gone, into, around)[~(around == into).any(1)]
            if len(changed) and heights_of(uv[changed]).min() <= max(heights[f], 0):
                continue
            merged = np.where(faces == gone, into, faces)
            return merged[~((faces == gone).any(1) & (faces == into).any(1))]
    return None


def area_of(corners: np.ndarray) -> np.ndarray:
    """Signed areas of plane triangles [F, 3, 2]."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return 0.5 * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def _matrix(values: np.ndarray, pairs: np.ndarray, size: int) -> csr_matrix:
    i, j = pairs.T
    both = np.concatenate([values, values]), (np.concatenate([i, j]), np.concatenate([j, i]))
    return coo_matrix(both, shape=(size, size)).tocsr()


def _lengths(vertices: np.ndarray, faces: np.ndarray) -> csr_matrix:
    pairs = np.array(list(edges_of(faces)))
    return _matrix(np.linalg.norm(vertices[pairs[:, 0]] - vertices[pairs[:, 1]], axis=1), pairs, len(vertices))


def _place(faces: np.ndarray, face: int, vertex: int) -> int:
    return int(np.flatnonzero(faces[face] == vertex)[0])


def _others(k: int) -> tuple[int, int, int]:
    return k, (k + 1) % 3, (k + 2) % 3


def _spread_out(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Classical scaling of the distances along the mesh: flat already where the garment is developable."""
    squared = dijkstra(_lengths(vertices, faces)) ** 2
    centred = squared - squared.mean(0) - squared.mean(1)[:, None] + squared.mean()
    value, vector = np.linalg.eigh(-0.5 * centred)
    return vector[:, -2:] * np.sqrt(value[-2:])


def _in_own_plane(corners: np.ndarray) -> np.ndarray:
    """Isometric copies [F, 3, 2] of triangles [F, 3, 3]."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    length = np.linalg.norm(a, axis=1)
    along, across = (a * b).sum(1) / length, np.linalg.norm(np.cross(a, b), axis=1) / length
    zero = np.zeros_like(length)
    return np.stack([np.stack([zero, zero], -1), np.stack([length, zero], -1), np.stack([along, across], -1)], axis=1)


def _cotangent(rest: np.ndarray, k: int, i: int, j: int) -> np.ndarray:
    a, b = rest[:, i] - rest[:, k], rest[:, j] - rest[:, k]
    return np.maximum((a * b).sum(1) / np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), LEAST_WEIGHT)


def _laplacian(pairs: list[np.ndarray], weight: np.ndarray, size: int) -> np.ndarray:
    out = np.zeros((size, size))
    for k, pair in enumerate(pairs):
        i, j = pair.T
        for a, b, sign in ((i, i, 1), (j, j, 1), (i, j, -1), (j, i, -1)):
            np.add.at(out, (a, b), sign * weight[:, k])
    return out


def _rotations(spread: np.ndarray) -> np.ndarray:
    """Nearest rotations of [F, 2, 2]."""
    angle = np.arctan2(spread[:, 1, 0] - spread[:, 0, 1], spread[:, 0, 0] + spread[:, 1, 1])
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], axis=-2)
