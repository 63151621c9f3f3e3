"""Line mass: extra mass along hems and seams."""

from __future__ import annotations

import itertools
from typing import Literal

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from ..errors import InvalidInput
from ..meshes import Mesh
from ..parameters import PhysicalParameter
from .base import AbstractEffect, Amplitude

EDGE_WEIGHT_TOLERANCE = 1e-9  # barycentric weight by which a line may lie outside a triangle and still count


class LineMass(AbstractEffect):
    """Extra mass along lines of the cloth, per rest length: hems, seams, piping. It has weight only with ``Gravity``.

    Contact between layers uses the areal density alone. The bending stiffness of the line is not modelled.

    Args:
        mass_per_length: m_h [kg/m], >= 0; a scalar, or [B, 1] for a batch. Two extra layers of 150 g/m^2, 15 mm wide,
            have 4.5e-3.
        edges: "boundary" (all free edges), "seams", or vertex pairs [N, 2] that are edges of the mesh.
        path: [N, 2] m, pattern points that straight lines join, instead of edges. Lines may cross triangles: their mass
            goes to the corners by barycentric weights, so the line is the same on every mesh. Parts outside the
            pattern have no mass.

    Raises:
        InvalidInput: negative mass; when bound, edges that the mesh does not have, or a path outside its pattern.
    """

    amplitudes = {
        "mass_per_length": Amplitude(
            unit="kg/m",
            typical=4.5e-3,
            confounded_with=("mass.density", "env.gravity_tilt"),
            cause="mass.hem",
            title="Mass of a hem",
            description="A heavy line runs along the rim.",
            diagnosis_typical=0.02,
        ),
    }
    per_triangle = ()

    def __init__(
        self,
        mass_per_length: float | Tensor = 4.5e-3,
        edges: Literal["boundary", "seams"] | ArrayLike = "boundary",
        path: ArrayLike | None = None,
    ) -> None:
        super().__init__()
        if isinstance(mass_per_length, Tensor) and mass_per_length.ndim and mass_per_length.shape[-1] != 1:
            raise InvalidInput(
                "mass per length", got=f"shape {tuple(mass_per_length.shape)}", expected="a number or [B, 1]"
            )
        if isinstance(edges, str) and edges not in ("boundary", "seams"):
            raise InvalidInput("edges", got=repr(edges), expected='"boundary", "seams" or vertex pairs [N, 2]')
        self.mass_per_length = PhysicalParameter(mass_per_length, "kg/m", "nonnegative", name="mass per length")
        self.edges = edges if isinstance(edges, str) else np.asarray(edges)
        self.path = None if path is None else _check_path(np.asarray(path, dtype=np.float64))
        self.register_buffer("length", torch.zeros(0, 1), persistent=False)
        self.length: Tensor  # [V, 1] m, length of line at each vertex

    def bind(self, mesh: Mesh) -> LineMass:
        """Distribute the line's length over the vertices, and return self; an edge gives half to each end.

        Raises:
            InvalidInput: edges that the mesh does not have, or a path outside its pattern.
        """
        if self.path is None:
            edges, length = _rest_lengths(mesh)
            row = _edge_rows(edges, self._pairs(mesh))
            per_vertex = np.bincount(edges[row].ravel(), np.repeat(length[row] / 2, 2), minlength=len(mesh.vertices))
        else:
            per_vertex = _path_lengths(mesh, self.path)
        raw = self.mass_per_length.raw
        self.length = torch.as_tensor(per_vertex, dtype=torch.get_default_dtype(), device=raw.device).unsqueeze(-1)
        return self

    def _pairs(self, mesh: Mesh) -> np.ndarray:
        if not isinstance(self.edges, str):
            return self.edges
        pairs = mesh.boundary_edges if self.edges == "boundary" else mesh.seams
        if len(pairs) == 0:
            raise InvalidInput("edges", got=repr(self.edges), expected="a mesh that has such edges")
        return pairs

    def coefficients(self) -> Tensor:
        """Return the mass per length, [..., 1, 1] kg/m."""
        return self.mass_per_length.field

    def mass(self, c: Tensor) -> Tensor:
        """Return the line's mass on its vertices."""
        return c * self.length


def _rest_lengths(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Return all edges [N, 2], lower vertex first, and their rest lengths [N] m, the mean where two panels differ."""
    sides = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    length = np.linalg.norm(np.roll(mesh.rest, -1, axis=1) - mesh.rest, axis=-1).ravel()
    edges, inverse, count = np.unique(sides, axis=0, return_inverse=True, return_counts=True)
    return edges, np.bincount(inverse.ravel(), length) / count


def _edge_rows(edges: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Return the rows of ``edges`` that are the vertex ``pairs``, each once."""
    if pairs.ndim != 2 or pairs.shape[1] != 2 or len(pairs) == 0 or pairs.dtype.kind not in "iu":
        raise InvalidInput(
            "edges", got=f"shape {pairs.shape} of {pairs.dtype}", expected="vertex indices [N, 2], N > 0"
        )
    row = {pair: k for k, pair in enumerate(map(tuple, edges.tolist()))}
    wanted = sorted(set(map(tuple, np.sort(pairs, axis=1).tolist())))
    unknown = [pair for pair in wanted if pair not in row]
    if unknown:
        raise InvalidInput(
            "edges", got=f"{len(unknown)} pairs that no triangle joins (first: {unknown[0]})", expected="mesh edges"
        )
    return np.array([row[pair] for pair in wanted])


def _check_path(path: np.ndarray) -> np.ndarray:
    if path.ndim != 2 or path.shape[1] != 2 or len(path) < 2 or not np.isfinite(path).all():
        raise InvalidInput("path", got=f"shape {path.shape}", expected="[N, 2] m on the pattern, N > 1, finite")
    return path


def _path_lengths(mesh: Mesh, path: np.ndarray) -> np.ndarray:
    """[V] m of the path's lines at each vertex: of what lies in a triangle, its corners' mean weights."""
    if mesh.pattern is None:
        raise InvalidInput("path", got="a mesh without pattern coordinates", expected="one that has them (vt)")
    share = sum(_within(mesh, mesh.pattern, start, end) for start, end in itertools.pairwise(path))
    if not np.any(share):
        raise InvalidInput("path", got="lines beside the pattern", expected="lines across it", remedy="metres?")
    return np.asarray(share)


def _within(mesh: Mesh, corners: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """[V] m of one line through triangles [F, 3, 2]; what lies along an edge is shared by its triangles."""
    sides = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], -1)
    offset = np.stack([start, end]) - corners[:, :1]  # [F, 2, 2]
    second = np.linalg.solve(sides[:, None], offset[..., None])[..., 0]
    weight = np.concatenate([1 - second.sum(-1, keepdims=True), second], -1)  # [F, 2, 3], linear along the line
    a, slope = weight[:, 0] + EDGE_WEIGHT_TOLERANCE, weight[:, 1] - weight[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        zero = -a / slope
    out = np.where(slope == 0, a < 0, False).any(-1)
    enters = np.where(slope > 0, zero, 0.0).max(-1).clip(min=0.0)
    leaves = np.where(slope < 0, zero, 1.0).min(-1).clip(max=1.0)
    there = np.flatnonzero((leaves > enters) & ~out)
    enters, leaves = enters[there, None], leaves[there, None]
    ends = np.unique(np.concatenate([enters, leaves]))
    middle, length = 0.5 * (ends[1:] + ends[:-1]), np.diff(ends)
    covers = (enters < middle) & (middle < leaves)  # [F', pieces]
    part = np.where(covers, length / covers.sum(0).clip(min=1), 0.0)
    moment = (part[..., None] * (weight[there, 0][:, None] + middle[:, None] * slope[there][:, None])).sum(1)
    total = np.linalg.norm(end - start) * moment
    return np.bincount(mesh.faces[there].ravel(), total.ravel(), minlength=len(mesh.vertices))
