"""Flatten a sewn garment: cut it open along edges, then map it into the plane nearly isometrically.

A recording's mesh has one pattern coordinate per vertex, which a closed garment cannot have: it must be open at seams.
Cutting doubles the vertices on a seam. They are not sewn together afterwards.
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
MIN_COTANGENT_WEIGHT = 0.2  # of an edge: obtuse slivers have negative cotangents, which fold the map


class FlatMesh(NamedTuple):
    """A mesh in the plane.

    Attributes:
        uv: [V, 2] m.
        stretch: [F, 2] -, singular values of the map from the triangle in space to the plane.
        flipped: number of triangles without a positive area.
    """

    uv: np.ndarray
    stretch: np.ndarray
    flipped: int


def map_edges_to_faces(faces: np.ndarray) -> dict[Edge, list[int]]:
    """Return the faces of each edge (lower vertex, higher vertex)."""
    out: dict[Edge, list[int]] = defaultdict(list)
    for f, (a, b, c) in enumerate(faces.tolist()):
        for i, j in ((a, b), (b, c), (c, a)):
            out[min(i, j), max(i, j)].append(f)
    return out


def find_boundary_loops(faces: np.ndarray) -> list[np.ndarray]:
    """Return the vertices of every boundary, the longest one first."""
    pairs = np.array([edge for edge, owners in map_edges_to_faces(faces).items() if len(owners) == 1])
    size = int(faces.max()) + 1
    label = connected_components(_symmetric_matrix(np.ones(len(pairs)), pairs, size))[1]
    used = np.unique(pairs)
    loops = [used[label[used] == k] for k in np.unique(label[used])]
    return sorted(loops, key=len, reverse=True)


def find_shortest_path(vertices: np.ndarray, faces: np.ndarray, start: np.ndarray, end: np.ndarray) -> list[Edge]:
    """Return the edges of the shortest path from any vertex of ``start`` to any of ``end``."""
    distance, predecessor, _ = dijkstra(
        _edge_length_graph(vertices, faces), indices=start, return_predecessors=True, min_only=True
    )
    path = [int(end[np.argmin(distance[end])])]
    while predecessor[path[-1]] >= 0:
        path.append(int(predecessor[path[-1]]))
    return [(min(e), max(e)) for e in pairwise(path)]


def cut_mesh(faces: np.ndarray, along: Iterable[Edge]) -> tuple[np.ndarray, np.ndarray]:
    """Open a mesh along edges, and drop all but its largest component.

    Returns:
        Faces [F', 3] of the new mesh, and the old vertex [V'] of each new one.
    """
    seam = set(along)
    pairs = [
        (3 * owners[0] + _corner_index(faces, owners[0], v), 3 * other + _corner_index(faces, other, v))
        for edge, owners in map_edges_to_faces(faces).items()
        if edge not in seam
        for other in owners[1:]
        for v in edge
    ]
    corner = connected_components(_symmetric_matrix(np.ones(len(pairs)), np.array(pairs), 3 * len(faces)))[1].reshape(
        -1, 3
    )
    ring = np.concatenate([corner[:, [0, 1]], corner[:, [1, 2]]])
    component = connected_components(_symmetric_matrix(np.ones(len(ring)), ring, int(corner.max()) + 1))[1][
        corner[:, 0]
    ]
    is_largest = component == np.bincount(component).argmax()
    old, new = np.unique(corner[is_largest], return_inverse=True)
    source = np.zeros(int(corner.max()) + 1, dtype=np.int64)
    source[corner] = faces
    return new.reshape(-1, 3), source[old]


def flatten(vertices: np.ndarray, faces: np.ndarray, iterations: int = 500) -> FlatMesh:
    """Map a disc into the plane as rigidly as possible (Liu et al. 2008), starting from geodesic distances."""
    uv = _embed_by_distances(vertices, faces)
    if signed_areas(uv[faces]).sum() < 0:
        uv = uv * [1.0, -1.0]
    rest = _flat_copies(vertices[faces])
    opposite = [(1, 2), (2, 0), (0, 1)]
    weight = np.stack([_cotangent(rest, *_cyclic_corners(k)) for k in range(3)], axis=1)
    pairs = [faces[:, list(opposite[k])] for k in range(3)]
    spans = [rest[:, i] - rest[:, j] for i, j in opposite]
    inverse = np.linalg.pinv(_assemble_laplacian(pairs, weight, len(vertices)))
    for _ in range(iterations):
        edges = [uv[p[:, 0]] - uv[p[:, 1]] for p in pairs]
        covariance = np.zeros((len(faces), 2, 2))
        for k in range(3):
            covariance += weight[:, k, None, None] * edges[k][:, :, None] * spans[k][:, None, :]
        turn = _nearest_rotations(covariance)
        target = np.zeros_like(uv)
        for k in range(3):
            edge = weight[:, k, None] * np.einsum("fab,fb->fa", turn, spans[k])
            np.add.at(target, pairs[k][:, 0], edge)
            np.add.at(target, pairs[k][:, 1], -edge)
        previous, uv = uv, inverse @ target
        if np.abs(uv - previous).max() < 1e-6:
            break
    flat = uv[faces]
    sides = np.stack([flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]], axis=-1)
    rest_sides = np.stack([rest[:, 1], rest[:, 2]], axis=-1)
    stretch = np.linalg.svd(sides @ np.linalg.inv(rest_sides), compute_uv=False)
    return FlatMesh(uv, stretch, int((signed_areas(flat) <= 0).sum()))


def collapse_slivers(uv: np.ndarray, faces: np.ndarray, height: float) -> tuple[np.ndarray, np.ndarray]:
    """Collapse edges of slivers in the plane until no triangle is thinner than ``height`` [m], if possible.

    A vertex is merged into a neighbour; nothing else moves. A merge that would fold a triangle over or change the
    topology is skipped; vertices on the boundary move along it only.

    Returns:
        Faces [F', 3] of the new mesh, and the old vertex [V'] of each new one.
    """
    faces = faces.copy()
    while (merge := _first_merge(uv, faces, height)) is not None:
        faces = merge
    old, new = np.unique(faces, return_inverse=True)
    return new.reshape(-1, 3), old


def triangle_heights(corners: np.ndarray) -> np.ndarray:
    """Return the smallest heights [F] m of plane triangles [F, 3, 2] m."""
    return 2 * signed_areas(corners) / np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).max(1)


def _first_merge(uv: np.ndarray, faces: np.ndarray, height: float) -> np.ndarray | None:
    """Return the faces after the first merge that thickens a thin triangle, thinnest first; None if there is none."""
    heights = triangle_heights(uv[faces])
    edges = map_edges_to_faces(faces)
    outline = {v for edge, owners in edges.items() if len(owners) == 1 for v in edge}
    for f in np.flatnonzero(heights < height)[np.argsort(heights[heights < height])]:
        ring = [(int(faces[f, i]), int(faces[f, j])) for i, j in ((0, 1), (1, 2), (2, 0))]
        directed = [*ring, *((b, a) for a, b in ring)]
        merges = sorted(directed, key=lambda merge: np.linalg.norm(uv[merge[0]] - uv[merge[1]]))
        for removed, target in merges:
            owners = edges[min(removed, target), max(removed, target)]
            if removed in outline and len(owners) == 2:
                continue
            around = faces[(faces == removed).any(1)]
            if len(np.intersect1d(around, faces[(faces == target).any(1)])) != 2 + len(owners):
                continue  # they share more neighbours than the triangles between them
            changed = np.where(around == removed, target, around)[~(around == target).any(1)]
            if len(changed) and triangle_heights(uv[changed]).min() <= max(heights[f], 0):
                continue
            merged = np.where(faces == removed, target, faces)
            return merged[~((faces == removed).any(1) & (faces == target).any(1))]
    return None


def signed_areas(corners: np.ndarray) -> np.ndarray:
    """Return the signed areas [F] m^2 of plane triangles [F, 3, 2] m."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return 0.5 * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def _symmetric_matrix(values: np.ndarray, pairs: np.ndarray, size: int) -> csr_matrix:
    i, j = pairs.T
    both = np.concatenate([values, values]), (np.concatenate([i, j]), np.concatenate([j, i]))
    return csr_matrix(coo_matrix(both, shape=(size, size)))


def _edge_length_graph(vertices: np.ndarray, faces: np.ndarray) -> csr_matrix:
    pairs = np.array(list(map_edges_to_faces(faces)))
    return _symmetric_matrix(
        np.linalg.norm(vertices[pairs[:, 0]] - vertices[pairs[:, 1]], axis=1), pairs, len(vertices)
    )


def _corner_index(faces: np.ndarray, face: int, vertex: int) -> int:
    return int(np.flatnonzero(faces[face] == vertex)[0])


def _cyclic_corners(k: int) -> tuple[int, int, int]:
    return k, (k + 1) % 3, (k + 2) % 3


def _embed_by_distances(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Embed the distances along the mesh in the plane (classical scaling): exact where the garment is developable."""
    squared = dijkstra(_edge_length_graph(vertices, faces)) ** 2
    centred = squared - squared.mean(0) - squared.mean(1)[:, None] + squared.mean()
    value, vector = np.linalg.eigh(-0.5 * centred)
    return vector[:, -2:] * np.sqrt(value[-2:])


def _flat_copies(corners: np.ndarray) -> np.ndarray:
    """Return isometric copies [F, 3, 2] of triangles [F, 3, 3]."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    length = np.linalg.norm(a, axis=1)
    along, across = (a * b).sum(1) / length, np.linalg.norm(np.cross(a, b), axis=1) / length
    zero = np.zeros_like(length)
    return np.stack([np.stack([zero, zero], -1), np.stack([length, zero], -1), np.stack([along, across], -1)], axis=1)


def _cotangent(rest: np.ndarray, k: int, i: int, j: int) -> np.ndarray:
    a, b = rest[:, i] - rest[:, k], rest[:, j] - rest[:, k]
    return np.maximum((a * b).sum(1) / np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), MIN_COTANGENT_WEIGHT)


def _assemble_laplacian(pairs: list[np.ndarray], weight: np.ndarray, size: int) -> np.ndarray:
    out = np.zeros((size, size))
    for k, pair in enumerate(pairs):
        i, j = pair.T
        for a, b, sign in ((i, i, 1), (j, j, 1), (i, j, -1), (j, i, -1)):
            np.add.at(out, (a, b), sign * weight[:, k])
    return out


def _nearest_rotations(m: np.ndarray) -> np.ndarray:
    """Return the rotations nearest to matrices [F, 2, 2]."""
    angle = np.arctan2(m[:, 1, 0] - m[:, 0, 1], m[:, 0, 0] + m[:, 1, 1])
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], axis=-2)
