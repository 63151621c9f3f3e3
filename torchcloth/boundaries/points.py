"""Contact points on the edges and triangles of a mesh."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from .._utils.linalg import dot
from ..meshes import Mesh
from ..meshes.topology import find_edges

# Smaller changes of velocity are no contact. A point that a pass has stopped keeps rounding errors of either sign. If
# these counted as contact, its vertices would split their mass or not by chance.
MIN_CONTACT_SPEED_CHANGE_M_PER_S = 1e-6


class TrianglePoints(nn.Module):
    """Points at barycentric coordinates in the triangles, whose impulses go to the corners.

    Args:
        mesh: the cloth.
        spacing: largest distance of neighbouring points [m], on the mean edge or on two thirds of the longest one.
    """

    def __init__(self, mesh: Mesh, spacing: float) -> None:
        super().__init__()
        index, weight = _lattice(mesh.faces, int(np.ceil(mesh.coarse_edge / spacing - 1e-9)))
        dtype = torch.get_default_dtype()
        self.register_buffer("index", torch.as_tensor(index.T.ravel().copy()), persistent=False)
        self.register_buffer("weight", torch.as_tensor(weight.T[..., None].copy(), dtype=dtype), persistent=False)
        self.index: Tensor  # [3 P], vertices: all first corners, then all second, then all third
        self.weight: Tensor  # [3, P, 1], barycentric coordinates

    def interpolate(self, field: Tensor) -> Tensor:
        """Interpolate values [..., V, 3] at the vertices to the points, [..., P, 3]."""
        return (self.weight * self._corners(field)).sum(-3)

    def distribute(self, change: Tensor, mass: Tensor) -> Tensor:
        """Distribute changes of the points' velocities over the vertices.

        Each vertex splits its mass among its points that touch the body, by weight (mass splitting: Tonge,
        Benevolenski and Voroshilov 2012). The impulse of a point is the one that changes its own velocity as wanted. It
        goes to the corners by weight, which conserves linear and angular momentum. No vertex is pushed twice for one
        contact.

        Args:
            change: [..., P, 3] m/s, wanted changes at the points.
            mass: [..., V, 1], vertex masses in any unit.

        Returns:
            Changes at the vertices, [..., V, 3] m/s.
        """
        vertices = mass.shape[-2]
        with torch.no_grad():
            touches = (dot(change, change) > MIN_CONTACT_SPEED_CHANGE_M_PER_S**2).to(change)
            weight_sum = self._corners(self._sum_on_vertices(self.weight * touches.unsqueeze(-3), vertices))
        per_mass = self.weight / self._corners(mass)
        mobility = (per_mass * weight_sum).sum(-3)  # of a point whose corners have the masses m b / sum(b)
        impulse = torch.where(touches > 0, change / torch.where(touches > 0, mobility, 1.0), 0.0)
        return self._sum_on_vertices(per_mass * impulse.unsqueeze(-3), vertices)

    def _corners(self, field: Tensor) -> Tensor:
        return field.index_select(-2, self.index).unflatten(-2, (3, -1))

    def _sum_on_vertices(self, shares: Tensor, vertices: int) -> Tensor:
        """Sum [..., 3, P, K] on the vertices, [..., V, K]."""
        stacked = shares.flatten(-3, -2)
        total = stacked.new_zeros(*stacked.shape[:-2], vertices, stacked.shape[-1])
        return total.scatter_add(-2, self.index.unsqueeze(-1).expand(stacked.shape), stacked)


def _lattice(faces: np.ndarray, parts: int) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices [P, 3] and weights [P, 3] that cut edges and triangles into ``parts`` equal parts each."""
    sides = find_edges(faces)[0]
    index, weight = [np.zeros((0, 3), np.int64)], [np.zeros((0, 3))]
    for i in range(1, parts):
        index.append(sides[:, [0, 1, 1]])
        weight.append(np.broadcast_to([1 - i / parts, i / parts, 0.0], (len(sides), 3)))
        for j in range(1, parts - i):
            index.append(faces)
            weight.append(np.broadcast_to([1 - (i + j) / parts, i / parts, j / parts], (len(faces), 3)))
    return np.concatenate(index), np.concatenate(weight)
