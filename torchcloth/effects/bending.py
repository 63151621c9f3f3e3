"""Bending stiffness, and its damping."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..errors import InvalidInput
from ..meshes import Mesh
from ..parameters import PhysicalParameter
from ..types import ClothState, Surface
from .base import AbstractEffect


class Coefficients(NamedTuple):
    """Bending stiffness [N m] and the same times the damping time [N m s]."""

    stiffness: Tensor
    viscosity: Tensor


class Bending(AbstractEffect):
    """Isotropic bending of a sheet that is flat at rest: energy B/2 integral |Laplacian x|^2.

    On the mesh it is a constant quadratic form of the cotangent Laplacian (isometric bending: exact where bending does
    not stretch), so that the force is linear in the positions. Hinge formulas depend on the direction of the diagonals
    (factors 3 to 4.5 on our sheets), this does not. Damping is proportional to it: x + time * v.

    Args:
        stiffness: B [N m], >= 0; fabrics have 1e-6 to 1e-4.
        damping_time: ratio of viscous to elastic bending moment [s], a constant.

    Raises:
        InvalidInput: negative values.
    """

    unit, typical, smallest = "N m", 1e-5, 1e-6

    def __init__(self, stiffness: float | Tensor = 1e-5, damping_time: float = 0.0) -> None:
        super().__init__()
        if not damping_time >= 0:
            raise InvalidInput("bending damping_time", got=f"{damping_time} s", expected="a time >= 0")
        self.stiffness = PhysicalParameter(stiffness, "N m", "nonnegative", name="bending stiffness")
        self.damping_time = float(damping_time)
        self.register_buffer("stencil", torch.zeros(0, dtype=torch.long), persistent=False)
        self.register_buffer("weight", torch.zeros(1, 0, 1), persistent=False)
        self.register_buffer("row_sum", torch.zeros(0, 1), persistent=False)
        self.stencil: Tensor
        self.weight: Tensor
        self.row_sum: Tensor

    def bind(self, mesh: Mesh) -> Bending:
        """Build the curvature stencils of the mesh's vertices."""
        stencil, weight = _stencils(mesh)
        rows = np.zeros(len(mesh.vertices))
        absolute = np.abs(weight)
        np.add.at(rows, stencil.ravel(), (absolute * absolute.sum(0)).ravel())
        dtype = torch.get_default_dtype()
        self.stencil = torch.as_tensor(stencil.ravel())
        self.weight = torch.as_tensor(weight, dtype=dtype).unsqueeze(-1)
        self.row_sum = torch.as_tensor(rows, dtype=dtype).unsqueeze(-1)
        return self

    def coefficients(self) -> Coefficients:
        """Resolved once per rollout."""
        value = self.stiffness.value
        value = value.unsqueeze(-1) if value.ndim else value
        return Coefficients(value, value * self.damping_time)

    def force(self, c: Coefficients, state: ClothState, surface: Surface, mass: Tensor) -> Tensor:
        """-B Q (x + damping_time v) on each vertex."""
        moment = c.stiffness * self._curvature(state.x) + c.viscosity * self._curvature(state.v)
        shares = -(self.weight * moment.unsqueeze(-3)).flatten(-3, -2)
        index = self.stencil.unsqueeze(-1).expand(shares.shape)
        return torch.zeros_like(state.x).expand(*shares.shape[:-2], -1, -1).scatter_add(-2, index, shares)

    def energy(self, c: Coefficients, x: Tensor) -> Tensor:
        """Bending energy [...] J."""
        return 0.5 * (c.stiffness * self._curvature(x) ** 2).sum((-2, -1))

    def rates(self, c: Coefficients, mass: Tensor) -> tuple[Tensor, Tensor]:
        """Gershgorin bound of the quadratic form over the vertices' masses."""
        bound = (self.row_sum / mass).amax()
        return c.stiffness.amax() * bound, c.viscosity.amax() * bound

    def _curvature(self, field: Tensor) -> Tensor:
        """Curvature vector times the root of its area [..., S, 3]."""
        corners = field.index_select(-2, self.stencil).unflatten(-2, (len(self.weight), -1))
        return (self.weight * corners).sum(-3)

    def extra_repr(self) -> str:
        """One line of the data sheet."""
        return f"damping_time={self.damping_time:g} s"


def _stencils(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [D, S] and weights [D, S] 1/m of the curvature at every vertex: Laplacian / sqrt(area).

    Inside: the cotangent Laplacian. On the rim, where that would mix in the slope across it: the second difference
    along the rim. Rows are padded with weight 0.
    """
    rim = _rim(mesh)
    cotangent = _cotangents(mesh)
    area = _mixed_area(mesh, cotangent)
    rows: list[dict[int, float]] = [{} for _ in mesh.vertices]
    for face, cot in zip(mesh.faces.tolist(), cotangent, strict=True):
        for corner in range(3):
            i, j, half = face[(corner + 1) % 3], face[(corner + 2) % 3], 0.5 * cot[corner]
            for a, b in ((i, j), (j, i)):
                rows[a][b] = rows[a].get(b, 0.0) + half
                rows[a][a] = rows[a].get(a, 0.0) - half
    for v, (first, second, before, after) in rim.items():
        scale = 2 * area[v] / (before + after)
        rows[v] = {first: scale / before, second: scale / after, v: -scale * (1 / before + 1 / after)}
    # a rim vertex where the rim ends or branches has no curvature of its own
    used = [v for v in range(len(rows)) if v in rim or v not in _rim_vertices(mesh)]
    kept = [{u: w for u, w in rows[v].items() if abs(w) > 1e-9 * abs(rows[v][v])} for v in used]
    depth = max((len(row) for row in kept), default=1)
    stencil, weight = np.zeros((depth, len(kept)), dtype=np.int64), np.zeros((depth, len(kept)))
    for s, (v, row) in enumerate(zip(used, kept, strict=True)):
        stencil[:, s] = v
        for d, (u, w) in enumerate(row.items()):
            stencil[d, s], weight[d, s] = u, w / np.sqrt(area[v])
    return stencil, weight


def _rim_edges(mesh: Mesh) -> np.ndarray:
    """[R, 2] vertices of the edges that only one triangle has."""
    edges = np.sort(np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]), axis=1)
    unique, count = np.unique(edges, axis=0, return_counts=True)
    return unique[count == 1]


def _rim_vertices(mesh: Mesh) -> set[int]:
    return set(_rim_edges(mesh).ravel().tolist())


def _rim(mesh: Mesh) -> dict[int, tuple[int, int, float, float]]:
    """Straight rim vertices: their two neighbours along the rim and the distances to them [m]; corners are left out."""
    beside: dict[int, list[int]] = {}
    for a, b in _rim_edges(mesh).tolist():
        beside.setdefault(a, []).append(b)
        beside.setdefault(b, []).append(a)
    x = mesh.vertices
    out = {}
    for v, neighbours in beside.items():
        if len(neighbours) == 2:
            first, second = x[neighbours[0]] - x[v], x[neighbours[1]] - x[v]
            before, after = float(np.linalg.norm(first)), float(np.linalg.norm(second))
            if first @ second < -0.7 * before * after:
                out[v] = (*neighbours, before, after)
    return out


def _mixed_area(mesh: Mesh, cotangent: np.ndarray) -> np.ndarray:
    """[V] m^2, Voronoi area of each vertex, safe for obtuse triangles (Meyer et al. 2003).

    Thirds of the triangles would make the curvature energy depend on each vertex's valence.
    """
    area = np.zeros(len(mesh.vertices))
    for corner in range(3):
        b, c = (corner + 1) % 3, (corner + 2) % 3
        ab = ((mesh.rest[:, b] - mesh.rest[:, corner]) ** 2).sum(-1)
        ac = ((mesh.rest[:, c] - mesh.rest[:, corner]) ** 2).sum(-1)
        voronoi = (ab * cotangent[:, c] + ac * cotangent[:, b]) / 8
        obtuse = (cotangent < 0).any(1)
        share = np.where(obtuse, mesh.area * np.where(cotangent[:, corner] < 0, 0.5, 0.25), voronoi)
        np.add.at(area, mesh.faces[:, corner], share)
    return area


def _cotangents(mesh: Mesh) -> np.ndarray:
    """[F, 3] cotangent of the rest angle at each corner."""
    out = np.zeros((len(mesh.faces), 3))
    for corner in range(3):
        a = mesh.rest[:, (corner + 1) % 3] - mesh.rest[:, corner]
        b = mesh.rest[:, (corner + 2) % 3] - mesh.rest[:, corner]
        out[:, corner] = (a * b).sum(-1) / (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    return out
