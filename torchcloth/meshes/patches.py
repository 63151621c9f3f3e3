"""Gripped patches that end exactly at their radius, not at the nearest vertices.

A patch grips the vertices within its radius. With edges of 25 mm, a patch of 36 mm would grip 25 mm of the rim, and 11
mm of grip move a swinging cloth by millimetres. Here vertices near the patch's edge are moved onto it in the pattern,
and those around make room.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from . import topology
from .mesh import Mesh, signed_area

MAX_EDGE_MOVE_FRACTION = 0.65  # of an edge that crosses the patch's edge, by which one of its ends may move
MIN_MOVED_DISTANCE_RADII = 0.5  # nearer to the centre nothing is moved onto the edge
SMOOTHING_REACH_EDGES = 2.0  # within it, and within one radius at least, other vertices make room
MAX_STRAIGHT_RIM_TURN = 0.03  # 1 - cos of the turn at a vertex that may move along the rim: 14 degrees
MIN_LEFT_AREA_FRACTION = 0.25  # of a triangle's area


class Patch(NamedTuple):
    """All material within ``radius`` [m] of any of the ``centres`` [G, 2] m on the pattern."""

    centres: np.ndarray
    radius: float

    def offset_from_centre(self, uv: np.ndarray) -> np.ndarray:
        """Return the offsets [N, 2] m of pattern points from the nearest centre."""
        offsets = uv[:, None] - self.centres
        return offsets[np.arange(len(uv)), np.linalg.norm(offsets, axis=-1).argmin(1)]

    def has_vertices_on_edge(self, uv: np.ndarray) -> bool:
        """Return whether some vertices [V, 2] m lie on the patch's edge; else the mesh is too coarse or not fitted."""
        far = np.linalg.norm(self.offset_from_centre(uv), axis=1)
        return bool((np.abs(far - self.radius) <= 1e-6 * self.radius).any())


def fit_to_patches(mesh: Mesh, patches: Sequence[Patch]) -> np.ndarray:
    """Move pattern coordinates [V, 2] m so that no edge of a triangle crosses the edge of a patch.

    The mesh needs ``uv``. The rim of the cloth stays. Where an end of an edge would move too far, or a triangle would
    be squeezed too much, vertices stay where they are.
    """
    uv: np.ndarray = mesh.uv  # type: ignore[assignment]
    free = project_along_rim(mesh, uv)
    onto = np.full_like(uv, np.nan)
    for patch in patches:
        displacement = _onto(patch, uv, free, mesh.faces)
        onto = np.where(np.isnan(onto), displacement, onto)
    before = signed_area(uv[mesh.faces])
    while True:
        placed = uv + np.einsum("vij,vj->vi", free, _around(uv, onto, patches, mesh.mean_edge))
        moved = ~np.isnan(onto[:, 0])
        placed[moved] = uv[moved] + onto[moved]
        bad = np.unique(mesh.faces[signed_area(placed[mesh.faces]) < MIN_LEFT_AREA_FRACTION * before])
        if not len(bad):
            return placed
        if not moved[bad].any():
            return uv
        far = np.linalg.norm(onto[bad], axis=1)
        onto[bad[np.nanargmax(far)]] = np.nan


def _onto(patch: Patch, uv: np.ndarray, free: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return displacements onto the patch's edge, [V, 2] m; NaN for vertices that are not moved there.

    For each mesh edge that crosses the patch's edge one end is moved, the one with the shorter way. Three corners of a
    triangle on the edge would leave it hardly any area.
    """
    ends = topology.find_edges(faces)[0]
    offset = patch.offset_from_centre(uv)
    far = np.linalg.norm(offset, axis=1)
    inside = far <= patch.radius * (1 + 1e-9)
    way = np.einsum("vij,vj->vi", free, offset / np.maximum(far, 1e-12)[:, None])
    way = _reaching(offset, way, patch.radius)
    way[far < MIN_MOVED_DISTANCE_RADII * patch.radius] = np.nan
    cost = np.linalg.norm(way, axis=1)
    crossing = ends[inside[ends[:, 0]] != inside[ends[:, 1]]]
    most = MAX_EDGE_MOVE_FRACTION * np.linalg.norm(uv[crossing[:, 0]] - uv[crossing[:, 1]], axis=1) * (1 + 1e-9)
    pairs = [(cost[v], v, k) for k, edge in enumerate(crossing) for v in edge if cost[v] <= most[k]]
    on = np.abs(far - patch.radius) <= 1e-9 * patch.radius
    for _, v, k in sorted(pairs):
        if not on[crossing[k]].any() and on[faces[(faces == v).any(1)]].sum(1).max() != 2:
            on[v] = True
    return np.where(on[:, None], way, np.nan)


def _reaching(offset: np.ndarray, way: np.ndarray, radius: float) -> np.ndarray:
    """Return the shortest multiple of each ``way`` [V, 2] that leads from its offset [V, 2] m to the radius, or NaN."""
    square, mixed = (way**2).sum(1), (offset * way).sum(1)
    with np.errstate(invalid="ignore", divide="ignore"):
        root = np.sqrt(mixed**2 - square * ((offset**2).sum(1) - radius**2))
        tried = np.stack([root - mixed, -root - mixed]) / square
    tried[~np.isfinite(tried)] = np.nan
    far = np.where(np.isnan(tried), np.inf, np.abs(tried))
    return np.take_along_axis(tried, far.argmin(0)[None], 0)[0][:, None] * way


def _around(uv: np.ndarray, onto: np.ndarray, patches: Sequence[Patch], edge: float) -> np.ndarray:
    """Return displacements of all vertices, [V, 2] m: those of the nearest that are moved, fading with distance."""
    moved = ~np.isnan(onto[:, 0])
    if not moved.any():
        return np.zeros_like(uv)
    apart = np.linalg.norm(uv[:, None] - uv[moved], axis=-1)
    weight = 1 / np.maximum(apart, 1e-3 * edge) ** 4
    move = weight @ onto[moved] / weight.sum(1, keepdims=True)
    move *= np.clip(1 - apart.min(1) / max(SMOOTHING_REACH_EDGES * edge, *(p.radius for p in patches)), 0.0, 1.0)[
        :, None
    ]
    for patch in patches:
        far, after = (np.linalg.norm(patch.offset_from_centre(p), axis=1) for p in (uv, uv + move))
        inside = far <= patch.radius
        move *= np.where(inside, far / patch.radius, 1.0)[:, None]
        move[inside != (after <= patch.radius)] = 0.0
    return move


def project_along_rim(mesh: Mesh, uv: np.ndarray) -> np.ndarray:
    """Return projections [V, 2, 2] that keep displacements of the rim along it.

    Where the rim turns they are zero; at inner vertices they are the identity.
    """
    edges = mesh.boundary_edges
    side = uv[edges[:, 1]] - uv[edges[:, 0]]
    normal = np.stack([-side[:, 1], side[:, 0]], 1) / np.linalg.norm(side, axis=1, keepdims=True)
    across = np.zeros((len(uv), 2, 2))
    for end in edges.T:
        np.add.at(across, end, normal[:, :, None] * normal[:, None, :])
    size, axes = np.linalg.eigh(across)
    return np.einsum("vik,vk,vjk->vij", axes, size < MAX_STRAIGHT_RIM_TURN, axes)
