"""Which triangles are neighbours along the cloth, and which lie over each other."""

from __future__ import annotations

from heapq import heappop, heappush

import numpy as np
import torch

from ..._utils.linalg import EXACT_CDIST_MODE
from ...meshes import Mesh

MAX_LATERAL_OFFSET_EDGES = 0.6  # mean edges, of centroids of triangles that lie over each other
TRIANGLES_PER_DISTANCE_BLOCK = 512  # triangles whose distances from all others are in memory
MIN_HEIGHT_TO_OFFSET_RATIO = 0.3  # height over that: of bent cloth neighbours are less


def find_non_adjacent_triangles(mesh: Mesh, distance: float) -> np.ndarray:
    """[E, E] bool: the way along the rest shape between two triangles' centroids is longer than ``distance`` [m].

    Ways lead from triangle to triangle across shared edges (Dijkstra), so seams are crossed and gaps are not; they
    exceed the straight line by up to a quarter.
    """
    links = _links(mesh)
    out = np.ones((len(mesh.faces), len(mesh.faces)), dtype=bool)
    for start in range(len(mesh.faces)):
        done: dict[int, float] = {}
        queue = [(0.0, start)]
        while queue:
            length, triangle = heappop(queue)
            if triangle not in done:
                done[triangle] = length
                for beyond, step in links[triangle]:
                    if beyond not in done and length + step <= distance:
                        heappush(queue, (length + step, beyond))
        out[start, list(done)] = False
    return out


def _links(mesh: Mesh) -> list[list[tuple[int, float]]]:
    """For each triangle those across its edges, with the distance of the centroids when unfolded, about."""
    middle = mesh.rest.mean(1)
    sides: dict[tuple[int, int], list[tuple[int, float]]] = {}
    for triangle, face in enumerate(mesh.faces):
        for k in range(3):
            a, b = int(face[k]), int(face[(k + 1) % 3])
            edge = (mesh.rest[triangle, k] + mesh.rest[triangle, (k + 1) % 3]) / 2
            half = float(np.linalg.norm(edge - middle[triangle]))
            sides.setdefault((min(a, b), max(a, b)), []).append((triangle, half))
    links: list[list[tuple[int, float]]] = [[] for _ in mesh.faces]
    for meeting in sides.values():
        for own, half in meeting:
            links[own] += [(other, half + rest) for other, rest in meeting if other != own]
    return links


def find_overlapping_triangles(mesh: Mesh, gap: float) -> np.ndarray:
    """[N, 2] triangles of which the first lies over the second as the mesh is given, nearer than ``gap`` [m].

    Straight over it, but for a part of an edge, and without a common vertex: no two of a smooth sheet are.
    """
    middle = mesh.vertices[mesh.faces].mean(1)
    if np.linalg.svd(middle - middle.mean(0), compute_uv=False)[-1] < 1e-9 * mesh.extent:
        return np.zeros((0, 2), dtype=int)  # flat
    beside, places = MAX_LATERAL_OFFSET_EDGES * mesh.mean_edge, torch.from_numpy(middle)
    reach = float(np.hypot(gap, beside))
    near = [(torch.cdist(part, places, compute_mode=EXACT_CDIST_MODE) < reach).nonzero() for part in places.split(TRIANGLES_PER_DISTANCE_BLOCK)]
    own, other = torch.cat([pairs + pairs.new_tensor([k * TRIANGLES_PER_DISTANCE_BLOCK, 0]) for k, pairs in enumerate(near)]).numpy().T
    sides = mesh.vertices[mesh.faces[:, 1:]] - mesh.vertices[mesh.faces[:, :1]]
    normal = np.cross(sides[:, 0], sides[:, 1])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    away = middle[other] - middle[own]
    height = (away * normal[own]).sum(1)
    off = np.linalg.norm(away - height[:, None] * normal[own], axis=1)
    joined = (mesh.faces[own][:, :, None] == mesh.faces[other][:, None]).any((1, 2))
    kept = (np.abs(height) < gap) & (np.abs(height) > MIN_HEIGHT_TO_OFFSET_RATIO * off) & (off < beside) & ~joined
    return np.column_stack([own, other])[kept]
