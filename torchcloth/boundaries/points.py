"""Contact points on the edges and triangles of a mesh."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from .._utils.linalg import dot
from ..meshes import Mesh
from ..meshes.topology import find_edges

# Changes of velocity below it [m/s] are no contact. What a pass has stopped is left with rounding, of either sign; if
# that counted, a point's neighbours would get their full share of the mass or not by chance.
MIN_CONTACT_SPEED_CHANGE_M_PER_S = 1e-6


class TrianglePoints(nn.Module):
    """Points at barycentric places, whose impulses go to the corners.

    Args:
        mesh: the cloth.
        spacing: distance of neighbouring points, at most, on the mean edge, or on two thirds of the longest [m].
    """

    def __init__(self, mesh: Mesh, spacing: float) -> None:
        super().__init__()
        index, weight = _lattice(mesh.faces, int(np.ceil(mesh.coarse_edge / spacing - 1e-9)))
        dtype = torch.get_default_dtype()
        self.register_buffer("index", torch.as_tensor(index.T.ravel().copy()), persistent=False)
        self.register_buffer("weight", torch.as_tensor(weight.T[..., None].copy(), dtype=dtype), persistent=False)
        self.index: Tensor  # [3 P], first all first corners, then all second, then all third
        self.weight: Tensor  # [3, P, 1]

    def interpolate(self, field: Tensor) -> Tensor:
        """Values [..., P, 3] at the points, of values [..., V, 3] at the vertices."""
        return (self.weight * self._corners(field)).sum(-3)

    def distribute(self, change: Tensor, mass: Tensor) -> Tensor:
        """Changes of the vertices' velocities [..., V, 3] that answer the wanted changes [..., P, 3] of the points.

        Each vertex splits its ``mass`` [..., V, 1] among its points that touch the body, by weight (mass splitting:
        Tonge, Benevolenski and Voroshilov 2012): a point's impulse is the one that changes its own velocity as wanted,
        and goes to its corners by weight, which keeps linear and angular momentum; no vertex is pushed twice for one
        cause.
        """
        vertices = mass.shape[-2]
        with torch.no_grad():
            touches = (dot(change, change) > MIN_CONTACT_SPEED_CHANGE_M_PER_S**2).to(change)
            claims = self._corners(self._gathered(self.weight * touches.unsqueeze(-3), vertices))
        light = self.weight / self._corners(mass)
        mobility = (light * claims).sum(-3)  # of a point that has its corners' parts of mass m b / sum(b)
        impulse = torch.where(touches > 0, change / torch.where(touches > 0, mobility, 1.0), 0.0)
        return self._gathered(light * impulse.unsqueeze(-3), vertices)

    def _corners(self, field: Tensor) -> Tensor:
        return field.index_select(-2, self.index).unflatten(-2, (3, -1))

    def _gathered(self, shares: Tensor, vertices: int) -> Tensor:
        """Sum [..., 3, P, K] on the vertices [..., V, K]."""
        stacked = shares.flatten(-3, -2)
        total = stacked.new_zeros(*stacked.shape[:-2], vertices, stacked.shape[-1])
        return total.scatter_add(-2, self.index.unsqueeze(-1).expand(stacked.shape), stacked)


def _lattice(faces: np.ndarray, parts: int) -> tuple[np.ndarray, np.ndarray]:
    """(corners [P, 3], weights [P, 3]) of edges and triangles in ``parts`` equal parts, without the vertices."""
    sides = find_edges(faces)[0]
    index, weight = [np.zeros((0, 3), np.int64)], [np.zeros((0, 3))]
    for i in range(1, parts):
        index.append(sides[:, [0, 1, 1]])
        weight.append(np.broadcast_to([1 - i / parts, i / parts, 0.0], (len(sides), 3)))
        for j in range(1, parts - i):
            index.append(faces)
            weight.append(np.broadcast_to([1 - (i + j) / parts, i / parts, j / parts], (len(faces), 3)))
    return np.concatenate(index), np.concatenate(weight)
