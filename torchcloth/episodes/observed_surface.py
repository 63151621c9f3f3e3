"""The cloth's surface as data see it: triangles, parts that err together, and the rim in straight pieces."""

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

BAND = 0.015  # m, along the rim, in which points tell where it is
CORNER = 30.0  # degrees, the turn of a rim at which a piece of it ends
SHORTEST = 0.03  # m, of a piece
ACROSS = 4  # parts along either axis of the pattern
EQUAL = 0.02  # relative, of sizes along two axes
PER_PIECE = 12  # points that a piece should have in a frame


class Rim(NamedTuple):
    """Edges of one triangle only, in straight pieces; held ones are left out."""

    edges: Tensor  # [B, 2] int64
    opposite: Tensor  # [B] int64, the third vertex of the triangle
    piece: Tensor  # [B] int64
    distance: Tensor  # [V, B] m, of every vertex from every edge, at rest
    label: Tensor  # [count] int64, the same for the same piece of the cloth on another mesh

    @property
    def count(self) -> int:
        """Of pieces."""
        return len(self.label)


class Sheet(NamedTuple):
    """What residuals need to know of a mesh."""

    faces: Tensor  # [F, 3] int64
    share: Tensor  # [V, 2] where a vertex is on the pattern, from 0 to 1 along each axis
    rim: Rim

    @property
    def patches(self) -> Tensor:
        """[V] int64, part of the fabric."""
        return patch_at(self.share)

    def patches_on(self, corners: Tensor, weights: Tensor) -> Tensor:
        """[N] int64, part of the fabric of points on triangles: ``corners`` [N, 3], barycentric ``weights`` [N, 3]."""
        return patch_at((weights[..., None] * self.share.to(weights)[corners]).sum(1))


def sheet_for(cloth: Cloth, episodes: Sequence[Episode]) -> Sheet:
    """With pieces of the rim that are long enough for the episodes' points, and without what grippers hold."""
    index = [part.index for part in cloth.boundaries.values() if isinstance(part, Grasp)]
    held = torch.cat(index).cpu().numpy() if index else None
    counts = sorted(len(cloud) for e in episodes for cloud in e.clouds if len(cloud))
    density = counts[len(counts) // 2] / float(cloth.mesh.area.sum()) if counts else torch.inf
    return sheet_of(cloth.mesh, held, max(SHORTEST, PER_PIECE / (density * BAND)))


def sheet_of(mesh: Mesh, held: np.ndarray | None = None, length: float = SHORTEST) -> Sheet:
    """The surface of a cloth, its rim in pieces of about ``length`` [m], without vertices that are ``held``."""
    return Sheet(torch.as_tensor(mesh.faces), share_of(mesh), rim_of(mesh, held, length))


def share_of(mesh: Mesh) -> Tensor:
    """[V, 2] where each vertex is between the ends of the fabric, along the pattern's axes.

    Where there is no pattern, along its principal ones: those of a square are anyone's guess, and differ from mesh to
    mesh, so the two that span its plane are taken nearest to the world's.
    """
    place = mesh.uv if mesh.uv is not None else _flat(mesh.vertices)
    low, high = place.min(0), place.max(0)
    return torch.as_tensor((place - low) / np.maximum(high - low, 1e-12))


def patch_at(share: Tensor) -> Tensor:
    """[N] int64, which of ACROSS x ACROSS parts of the fabric a place [N, 2] belongs to."""
    cell = (ACROSS * (share + 1e-9)).long().clamp(0, ACROSS - 1)  # between two parts: the next, on every mesh
    return cell[:, 0] * ACROSS + cell[:, 1]


def _flat(x: np.ndarray) -> np.ndarray:
    """[V, 2] along the two longest principal axes, or, where these are as good as equal, nearest to the world's."""
    centred = x - x.mean(0)
    _, sizes, axes = np.linalg.svd(centred, full_matrices=False)
    plane, normal = axes[:2], axes[2]
    if sizes[1] > (1 - EQUAL) * sizes[0]:
        nearest = lambda lengths: int(np.round(np.abs(lengths), 6).argmax())  # noqa: E731 - rounding decides nothing
        first = plane[:, nearest(np.linalg.norm(plane, axis=0))] @ plane
        upwards = np.sign(normal[nearest(normal)]) * normal
        plane = np.stack([first, np.cross(upwards, first)]) / np.linalg.norm(first)
    return centred @ plane.T


def rim_of(mesh: Mesh, held: np.ndarray | None, length: float) -> Rim:
    """The rim in pieces of about ``length`` [m] that end at corners."""
    edges, opposite = _free_edges(mesh.faces)
    x = mesh.vertices if mesh.uv is None else np.pad(mesh.uv, ((0, 0), (0, 1)))
    piece, count = np.full(len(edges), -1), 0
    for run in _runs(edges, x):
        size = np.linalg.norm(x[edges[run, 1]] - x[edges[run, 0]], axis=1)
        parts = max(1, round(size.sum() / length))
        piece[run] = count + (parts * (np.cumsum(size) - 0.5 * size) / size.sum()).astype(int)
        count += parts
    used = np.ones(len(edges), bool) if held is None else ~np.isin(edges, held).any(1)
    label, number = np.unique(piece[used], return_inverse=True)
    distance = torch.as_tensor(_distances(x, edges[used]), dtype=torch.get_default_dtype())
    kept, third, number = (torch.as_tensor(a) for a in (edges[used], opposite[used], number))
    return Rim(kept, third, number, distance, torch.as_tensor(label))


def _free_edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directed edges [B, 2] of one triangle only, and the vertex opposite to each."""
    directed = np.concatenate([faces[:, [1, 2]], faces[:, [2, 0]], faces[:, [0, 1]]])
    third = np.concatenate([faces[:, 0], faces[:, 1], faces[:, 2]])
    _, inverse, count = np.unique(np.sort(directed, axis=1), axis=0, return_inverse=True, return_counts=True)
    free = count[inverse.ravel()] == 1
    return directed[free], third[free]


def _runs(edges: np.ndarray, x: np.ndarray) -> list[np.ndarray]:
    """Indices of edges in order, from corner to corner; a rim without corners is one run."""
    following = {int(a): i for i, (a, _) in enumerate(edges)}
    direction = x[edges[:, 1]] - x[edges[:, 0]]
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    after = np.array([following.get(int(b), -1) for b in edges[:, 1]], dtype=int)  # of a closed surface, none
    bends = (after < 0) | ((direction * direction[after]).sum(1) < np.cos(np.radians(CORNER)))
    begins = np.zeros(len(edges), bool)
    begins[after[bends & (after >= 0)]] = True
    left, runs = np.ones(len(edges), bool), []
    for i in [*np.flatnonzero(begins), *range(len(edges))]:
        run = []
        while i >= 0 and left[i]:
            left[i] = False
            run.append(i)
            i = -1 if bends[i] else after[i]
        if run:
            runs.append(np.array(run))
    return runs


def _distances(x: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """[V, B] m."""
    a, along = x[edges[:, 0]], x[edges[:, 1]] - x[edges[:, 0]]
    offset = x[:, None] - a
    s = np.clip((offset * along).sum(-1) / (along * along).sum(-1), 0, 1)
    return np.linalg.norm(offset - s[..., None] * along, axis=-1)
