"""Which triangles are neighbours along the cloth."""

from __future__ import annotations

from heapq import heappop, heappush

import numpy as np

from ..meshes import Mesh


def apart(mesh: Mesh, distance: float) -> np.ndarray:
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
