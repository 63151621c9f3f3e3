"""What may be added to MuJoCo's cloth: forces, masses and inertia, written in numpy and known to no other engine."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import csr_matrix

from .flex_sheet import rest_points

if TYPE_CHECKING:
    from .mujoco_cloth import MujocoCloth

Array = np.ndarray


class Hook:
    """One influence on the cloth. With all amplitudes 0 it adds exact zeros.

    Attributes:
        settles: acts while the cloth is brought to rest, too; what remembers or slips does not.
        reacts: has a ``reaction``.
        viscous: [V, V] kg/s, minus which times the velocities acts besides; taken at the end of a step, so that no step
            is too long for it. Where some hook reacts, who has one adds it to ``force`` instead.
    """

    settles = True
    reacts = False
    viscous: csr_matrix | None = None

    def start(self, cloth: MujocoCloth, x: Array) -> None:
        """Prepare for a run of this cloth from positions x [V, 3] m; forget what was."""

    def force(self, t: float, x: Array, v: Array) -> Array | float:
        """Force [V, 3] N at time t s, positions and velocities [V, 3]; called once a step, in order of time."""
        return 0.0

    def reaction(self, x: Array, total: Array) -> Array | float:
        """What inertia takes back [V, 3] N of all forces [V, 3] N on the vertices."""
        return 0.0


class Triangles:
    """Sums and means between V vertices and F triangles, and the gradients of what is linear on the triangles.

    Attributes:
        area: [F] m^2, at rest.
        along_u, along_v: [F, V] sparse, 1/m: derivatives by the rest coordinates.
        mean: [F, V] sparse: values at the centroids.
    """

    def __init__(self, cloth: MujocoCloth) -> None:
        self.faces = cloth.faces
        count, rest = len(cloth.uv), rest_points(cloth.spec)
        a, b, c = (rest[self.faces[:, k]] for k in range(3))
        inverse = np.linalg.inv(np.stack([b - a, c - a], 2))  # [F, 2, 2]: rows belong to b and c
        self.area = 0.5 / np.abs(np.linalg.det(inverse))
        gradient = np.concatenate([-inverse.sum(1, keepdims=True), inverse], 1)  # [F, 3, 2]
        rows, columns = np.repeat(np.arange(len(self.faces)), 3), self.faces.ravel()
        shape = (len(self.faces), count)
        self.along_u, self.along_v = (csr_matrix((gradient[:, :, k].ravel(), (rows, columns)), shape) for k in (0, 1))
        self.mean = csr_matrix((np.full(len(rows), 1 / 3), (rows, columns)), shape)
        self._from_u, self._from_v, self._shared = (m.T.tocsr() for m in (self.along_u, self.along_v, self.mean))

    def shared(self, values: Array) -> Array:
        """Values [F, K] of the triangles, a third to each corner: [V, K]."""
        return self._shared @ values

    def divergence(self, pu: Array, pv: Array) -> Array:
        """Forces [V, 3] N of stresses pu, pv [F, 3] N/m (first Piola-Kirchhoff columns): - area P grad N."""
        area = self.area[:, None]
        return -(self._from_u @ (area * pu) + self._from_v @ (area * pv))

    def area_normals(self, x: Array) -> Array:
        """[F, 3] m^2: unit normals times the current areas."""
        a, b, c = (x[self.faces[:, k]] for k in range(3))
        (px, py, pz), (qx, qy, qz) = (b - a).T, (c - a).T
        return 0.5 * np.stack([py * qz - pz * qy, pz * qx - px * qz, px * qy - py * qx], 1)


def dahl(share: Array, change: Array, threshold: float) -> Array:
    """Dahl friction as a share of its limit after the strain went on by ``change``: z' = (k' - |k'| z) / threshold."""
    path = change / threshold
    left = np.exp(-np.abs(path))
    return share * left + np.sign(path) * (1 - left)
