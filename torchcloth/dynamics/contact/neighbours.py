"""Which triangles are neighbours along the cloth, and which lie over each other."""

from __future__ import annotations

from heapq import heappop, heappush

import numpy as np
import torch

from ..._utils.linalg import EXACT_CDIST_MODE
from ...meshes import Mesh

MAX_LATERAL_OFFSET_EDGES = 0.6  # in mean edges, between centroids of triangles that lie over each other
MIN_HEIGHT_TO_OFFSET_RATIO = 0.3  # of such a pair; neighbours in bent cloth have less
TRIANGLES_PER_DISTANCE_BLOCK = 512  # whose distances to all others are in memory at the same time


def find_non_adjacent_triangles(mesh: Mesh, distance: float) -> np.ndarray:
    """Return [E, E] bool, pairs whose centroids are farther apart than ``distance`` [m] along the rest shape.

    Paths lead from triangle to triangle across shared edges (Dijkstra), so they cross seams but not gaps. They exceed
    the straight line by up to a quarter.
    """
    links = _links(mesh)
    non_adjacent = np.ones((len(mesh.faces), len(mesh.faces)), dtype=bool)
    for start in range(len(mesh.faces)):
        done: dict[int, float] = {}
        queue = [(0.0, start)]
        while queue:
            length, triangle = heappop(queue)
            if triangle not in done:
                done[triangle] = length
                for neighbour, step in links[triangle]:
                    if neighbour not in done and length + step <= distance:
                        heappush(queue, (length + step, neighbour))
        non_adjacent[start, list(done)] = False
    return non_adjacent


def _links(mesh: Mesh) -> list[list[tuple[int, float]]]:
    """Return, for each triangle, those across its edges, with the approximate distance of centroids when unfolded."""
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
        for triangle, half in meeting:
            links[triangle] += [(other, half + rest) for other, rest in meeting if other != triangle]
    return links


def find_overlapping_triangles(mesh: Mesh, gap: float) -> np.ndarray:
    """Return pairs of triangles [N, 2], the first over the second in ``mesh.vertices`` and nearer than ``gap`` [m].

    Such triangles lie straight over each other, but for a part of an edge, and share no vertex. A smooth sheet has
    none.
    """
    middle = mesh.vertices[mesh.faces].mean(1)
    is_flat = np.linalg.svd(middle - middle.mean(0), compute_uv=False)[-1] < 1e-9 * mesh.extent
    if is_flat:
        return np.zeros((0, 2), dtype=int)
    max_offset, centroids = MAX_LATERAL_OFFSET_EDGES * mesh.mean_edge, torch.from_numpy(middle)
    reach, block = float(np.hypot(gap, max_offset)), TRIANGLES_PER_DISTANCE_BLOCK
    near = [
        (torch.cdist(part, centroids, compute_mode=EXACT_CDIST_MODE) < reach).nonzero()
        for part in centroids.split(block)
    ]
    over, under = torch.cat([pairs + pairs.new_tensor([k * block, 0]) for k, pairs in enumerate(near)]).numpy().T
    sides = mesh.vertices[mesh.faces[:, 1:]] - mesh.vertices[mesh.faces[:, :1]]
    normal = np.cross(sides[:, 0], sides[:, 1])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    separation = middle[under] - middle[over]
    height = (separation * normal[over]).sum(1)
    offset = np.linalg.norm(separation - height[:, None] * normal[over], axis=1)
    is_joined = (mesh.faces[over][:, :, None] == mesh.faces[under][:, None]).any((1, 2))
    is_steep = np.abs(height) > MIN_HEIGHT_TO_OFFSET_RATIO * offset
    overlaps = (np.abs(height) < gap) & is_steep & (offset < max_offset) & ~is_joined
    return np.column_stack([over, under])[overlaps]
