"""The cloth's surface as data see it: triangles, groups of correlated errors, and the rim in straight pieces."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..boundaries import Grasp
from ..cloth import Cloth
from ..meshes import Mesh
from .observed import Episode

RIM_BAND_M = 0.015  # width of the band along the rim whose points show where the rim is
MIN_CORNER_TURN_DEG = 30.0  # turn of a rim at which a piece of it ends
MIN_RIM_PIECE_M = 0.03  # length of a piece
POINTS_PER_RIM_PIECE = 12  # that a piece should have in a frame
ERROR_GROUPS_PER_AXIS = 4  # parts of the fabric along either axis of the pattern
EQUAL_AXES_RELATIVE_TOLERANCE = 0.02  # difference of sizes along two axes that count as equal


class Rim(NamedTuple):
    """Edges of a single triangle, in straight pieces, without edges that grippers hold.

    Attributes:
        edges: [B, 2] int64.
        opposite: [B] int64, third vertex of the edge's triangle.
        piece: [B] int64.
        distance: [V, B] m, of every vertex from every edge, at rest.
        labels: [piece_count] int64, equal for the same piece of the cloth on another mesh.
    """

    edges: Tensor
    opposite: Tensor
    piece: Tensor
    distance: Tensor
    labels: Tensor

    @property
    def piece_count(self) -> int:
        """Number of the rim's pieces."""
        return len(self.labels)


class ObservedSurface(NamedTuple):
    """What residuals need to know of a mesh.

    Attributes:
        faces: [F, 3] int64.
        pattern_fraction: [V, 2] position of each vertex on the pattern, from 0 to 1 along each axis.
        rim: where clouds can show an end of the cloth.
    """

    faces: Tensor
    pattern_fraction: Tensor
    rim: Rim

    @property
    def error_groups(self) -> Tensor:
        """[V] int64, part of the fabric of each vertex, in which errors are correlated."""
        return error_group_at(self.pattern_fraction)

    def error_groups_at(self, corners: Tensor, weights: Tensor) -> Tensor:
        """Return the part of the fabric [N] int64 of points on triangles.

        Args:
            corners: [N, 3] int64, vertices of the triangles.
            weights: [N, 3] barycentric.
        """
        return error_group_at((weights[..., None] * self.pattern_fraction.to(weights)[corners]).sum(1))


def build_surface(cloth: Cloth, episodes: Sequence[Episode]) -> ObservedSurface:
    """Build a surface with rim pieces long enough for the episodes' points, without what grippers hold."""
    grasped = [part.index for part in cloth.boundaries.values() if isinstance(part, Grasp)]
    grasped_vertices = torch.cat(grasped).cpu().numpy() if grasped else None
    counts = sorted(len(cloud) for e in episodes for cloud in e.clouds if len(cloud))
    density = counts[len(counts) // 2] / float(cloth.mesh.area.sum()) if counts else torch.inf
    length = max(MIN_RIM_PIECE_M, POINTS_PER_RIM_PIECE / (density * RIM_BAND_M))
    return build_surface_of_mesh(cloth.mesh, grasped_vertices, length)


def build_surface_of_mesh(
    mesh: Mesh, grasped_vertices: np.ndarray | None = None, length: float = MIN_RIM_PIECE_M
) -> ObservedSurface:
    """Build the surface of a mesh.

    Args:
        mesh: of the cloth.
        grasped_vertices: whose edges do not belong to the rim.
        length: approximate length of a rim piece [m].
    """
    rim = build_rim(mesh, grasped_vertices, length)
    return ObservedSurface(torch.as_tensor(mesh.faces), compute_pattern_fractions(mesh), rim)


def compute_pattern_fractions(mesh: Mesh) -> Tensor:
    """Compute the position [V, 2] of each vertex between the ends of the fabric, along the pattern's axes.

    A mesh without a pattern has principal axes instead. Those of a square are arbitrary and differ from mesh to mesh,
    so the two that span its plane are taken nearest to the world's.
    """
    place = mesh.uv if mesh.uv is not None else _flatten(mesh.vertices)
    low, high = place.min(0), place.max(0)
    return torch.as_tensor((place - low) / np.maximum(high - low, 1e-12))


def error_group_at(pattern_fraction: Tensor) -> Tensor:
    """Return which of the 4 x 4 parts of the fabric [N] int64 a position [N, 2] belongs to."""
    n = ERROR_GROUPS_PER_AXIS
    # a place between two parts belongs to the next one, on every mesh
    cell = (n * (pattern_fraction + 1e-9)).long().clamp(0, n - 1)
    return cell[:, 0] * n + cell[:, 1]


def _flatten(x: np.ndarray) -> np.ndarray:
    """[V, 2] along the two longest principal axes, or nearest to the world's axes where these are nearly equal."""
    centred = x - x.mean(0)
    _, sizes, axes = np.linalg.svd(centred, full_matrices=False)
    plane, normal = axes[:2], axes[2]

    def argmax(lengths: np.ndarray) -> int:
        return int(np.round(np.abs(lengths), 6).argmax())  # so that rounding decides nothing

    if sizes[1] > (1 - EQUAL_AXES_RELATIVE_TOLERANCE) * sizes[0]:
        first = plane[:, argmax(np.linalg.norm(plane, axis=0))] @ plane
        upwards = np.sign(normal[argmax(normal)]) * normal
        plane = np.stack([first, np.cross(upwards, first)]) / np.linalg.norm(first)
    return centred @ plane.T


def build_rim(mesh: Mesh, grasped_vertices: np.ndarray | None, length: float) -> Rim:
    """Build the rim in pieces of about ``length`` [m] that end at corners, without edges of grasped vertices."""
    edges, opposite = _free_edges(mesh.faces)
    x = mesh.vertices if mesh.uv is None else np.pad(mesh.uv, ((0, 0), (0, 1)))
    piece, count = np.full(len(edges), -1), 0
    for run in _straight_runs(edges, x):
        size = np.linalg.norm(x[edges[run, 1]] - x[edges[run, 0]], axis=1)
        parts = max(1, round(size.sum() / length))
        piece[run] = count + (parts * (np.cumsum(size) - 0.5 * size) / size.sum()).astype(int)
        count += parts
    is_used = np.ones(len(edges), bool) if grasped_vertices is None else ~np.isin(edges, grasped_vertices).any(1)
    labels, number = np.unique(piece[is_used], return_inverse=True)
    distance = torch.as_tensor(_edge_distances(x, edges[is_used]), dtype=torch.get_default_dtype())
    used_edges, used_opposite, number = (torch.as_tensor(a) for a in (edges[is_used], opposite[is_used], number))
    return Rim(used_edges, used_opposite, number, distance, torch.as_tensor(labels))


def _free_edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directed edges [B, 2] of a single triangle, and the vertex opposite to each."""
    directed = np.concatenate([faces[:, [1, 2]], faces[:, [2, 0]], faces[:, [0, 1]]])
    third = np.concatenate([faces[:, 0], faces[:, 1], faces[:, 2]])
    _, inverse, count = np.unique(np.sort(directed, axis=1), axis=0, return_inverse=True, return_counts=True)
    is_free = count[inverse.ravel()] == 1
    return directed[is_free], third[is_free]


def _straight_runs(edges: np.ndarray, x: np.ndarray) -> list[np.ndarray]:
    """Indices of edges in order, from corner to corner; a rim without corners is one run."""
    edge_from = {int(a): i for i, (a, _) in enumerate(edges)}
    direction = x[edges[:, 1]] - x[edges[:, 0]]
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    after = np.array([edge_from.get(int(b), -1) for b in edges[:, 1]], dtype=int)  # a closed surface has no edges
    cosine = (direction * direction[after]).sum(1)
    ends_run = (after < 0) | (cosine < np.cos(np.radians(MIN_CORNER_TURN_DEG)))
    begins_run = np.zeros(len(edges), bool)
    begins_run[after[ends_run & (after >= 0)]] = True
    is_open, runs = np.ones(len(edges), bool), []
    for i in [*np.flatnonzero(begins_run), *range(len(edges))]:
        run = []
        while i >= 0 and is_open[i]:
            is_open[i] = False
            run.append(i)
            i = -1 if ends_run[i] else after[i]
        if run:
            runs.append(np.array(run))
    return runs


def _edge_distances(x: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """[V, B] m, of every vertex from every edge."""
    a, along = x[edges[:, 0]], x[edges[:, 1]] - x[edges[:, 0]]
    offset = x[:, None] - a
    s = np.clip((offset * along).sum(-1) / (along * along).sum(-1), 0, 1)
    return np.linalg.norm(offset - s[..., None] * along, axis=-1)
