"""Mass along lines: hems and seams."""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from ..errors import InvalidInput
from ..meshes import Mesh
from ..parameters import PhysicalParameter
from .base import AbstractEffect, Amplitude


class LineMass(AbstractEffect):
    """Extra mass along edges of the mesh, at rest lengths: hems, seams, piping. It has weight only with ``Gravity``.

    Contact between layers sees the areal density alone; the line's own bending stiffness is not modelled.

    Args:
        mass_per_length: m_h [kg/m], >= 0: a number, or [B, 1] for a batch. Two extra layers of 150 g/m^2, 15 mm wide,
            have 4.5e-3.
        edges: "boundary" (all free edges), "seams", or vertex pairs [N, 2] that are edges of the mesh.

    Raises:
        InvalidInput: negative mass, edges that the mesh does not have (when bound).
    """

    amplitudes = {"mass_per_length": Amplitude("kg/m", 4.5e-3, 1e-3, ("areal_density", "gravity.tilt"))}
    per_triangle = ()

    def __init__(
        self, mass_per_length: float | Tensor = 4.5e-3, edges: Literal["boundary", "seams"] | ArrayLike = "boundary"
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
        self.register_buffer("length", torch.zeros(0, 1), persistent=False)
        self.length: Tensor  # [V, 1] m, half of each line edge at the vertex

    def bind(self, mesh: Mesh) -> LineMass:
        """Half the rest length of every edge goes to each of its ends."""
        found, length = _rest_lengths(mesh)
        place = _places(found, self._pairs(mesh))
        share = np.bincount(found[place].ravel(), np.repeat(length[place] / 2, 2), minlength=len(mesh.vertices))
        raw = self.mass_per_length.raw
        self.length = torch.as_tensor(share, dtype=torch.get_default_dtype(), device=raw.device).unsqueeze(-1)
        return self

    def _pairs(self, mesh: Mesh) -> np.ndarray:
        if not isinstance(self.edges, str):
            return self.edges
        pairs = mesh.boundary_edges if self.edges == "boundary" else mesh.seams
        if len(pairs) == 0:
            raise InvalidInput("edges", got=repr(self.edges), expected="a mesh that has such edges")
        return pairs

    def coefficients(self) -> Tensor:
        """[..., 1, 1] kg/m."""
        return self.mass_per_length.field

    def mass(self, c: Tensor) -> Tensor:
        """The line's mass on its vertices."""
        return c * self.length


def _rest_lengths(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """(all edges [N, 2], lower vertex first; rest lengths [N] m, the mean where two panels disagree)."""
    sides = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    length = np.linalg.norm(np.roll(mesh.rest, -1, axis=1) - mesh.rest, axis=-1).ravel()
    edges, inverse, count = np.unique(sides, axis=0, return_inverse=True, return_counts=True)
    return edges, np.bincount(inverse.ravel(), length) / count


def _places(edges: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Rows of ``edges`` that are the vertex ``pairs``, each once."""
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
