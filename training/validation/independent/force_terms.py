"""Force terms that are added to MuJoCo's cloth: forces, masses and inertia, in numpy alone."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from scipy.sparse import csr_matrix

from .flex_sheet import SheetSpec, rest_positions

Array = np.ndarray


class SimulatedSheet(Protocol):
    """What a force term reads of the cloth that it acts on.

    Attributes:
        spec: size and nodes of the sheet.
        faces: [F, 3], indices of the triangles' vertices.
        uv: [V, 2] m, pattern coordinates.
    """

    spec: SheetSpec
    faces: Array
    uv: Array


class ForceTerm:
    """One influence on the cloth. With all amplitudes 0 it adds exact zeros.

    Attributes:
        acts_while_settling: also acts while the cloth is brought to rest. Terms that slip or have a memory do not.
        has_inertia: the term has an ``inertial_force``.
        damping_matrix: [V, V] kg/s. The force is minus this matrix times the velocities. It is taken at the end of a
            step, so no step is too long for it. If another term has inertia, ``force`` includes the damping instead.
    """

    acts_while_settling = True
    has_inertia = False
    damping_matrix: csr_matrix | None = None

    def reset(self, cloth: SimulatedSheet, x: Array) -> None:
        """Prepare for a run of this cloth from positions x [V, 3] m, and clear all memory."""

    def force(self, t: float, x: Array, v: Array) -> Array | float:
        """Return the force [V, 3] N at time t s, positions and velocities [V, 3].

        It is called once a step, in order of time.
        """
        return 0.0

    def inertial_force(self, x: Array, total: Array) -> Array | float:
        """Return the inertial force [V, 3] N of the term, given the sum of all forces [V, 3] N on the vertices."""
        return 0.0


class TriangleOperators:
    """Sums and means between V vertices and F triangles, and gradients of fields that are linear on the triangles.

    Attributes:
        area: [F] m^2, at rest.
        derivative_u: [F, V] sparse, 1/m, derivative by the rest coordinate along u.
        derivative_v: [F, V] sparse, 1/m, derivative by the rest coordinate along v.
        mean: [F, V] sparse, values at the centroids.
    """

    def __init__(self, cloth: SimulatedSheet) -> None:
        self.faces = cloth.faces
        count, rest = len(cloth.uv), rest_positions(cloth.spec)
        a, b, c = (rest[self.faces[:, k]] for k in range(3))
        inverse = np.linalg.inv(np.stack([b - a, c - a], 2))  # [F, 2, 2]: rows belong to b and c
        self.area = 0.5 / np.abs(np.linalg.det(inverse))
        gradient = np.concatenate([-inverse.sum(1, keepdims=True), inverse], 1)  # [F, 3, 2]
        rows, columns = np.repeat(np.arange(len(self.faces)), 3), self.faces.ravel()
        shape = (len(self.faces), count)
        self.derivative_u, self.derivative_v = (
            csr_matrix((gradient[:, :, k].ravel(), (rows, columns)), shape) for k in (0, 1)
        )
        self.mean = csr_matrix((np.full(len(rows), 1 / 3), (rows, columns)), shape)
        self._transposed_u, self._transposed_v = self.derivative_u.T.tocsr(), self.derivative_v.T.tocsr()
        self._transposed_mean = self.mean.T.tocsr()

    def distribute_to_vertices(self, values: Array) -> Array:
        """Distribute values [F, K] of the triangles, a third to each corner; returns [V, K]."""
        return self._transposed_mean @ values

    def nodal_forces(self, pu: Array, pv: Array) -> Array:
        """Return forces [V, 3] N of the stresses pu, pv [F, 3] N/m: - area P grad N.

        pu and pv are the columns of the first Piola-Kirchhoff stress.
        """
        area = self.area[:, None]
        return -(self._transposed_u @ (area * pu) + self._transposed_v @ (area * pv))

    def area_normals(self, x: Array) -> Array:
        """Return unit normals times the current areas [F, 3] m^2."""
        a, b, c = (x[self.faces[:, k]] for k in range(3))
        (px, py, pz), (qx, qy, qz) = (b - a).T, (c - a).T
        return 0.5 * np.stack([py * qz - pz * qy, pz * qx - px * qz, px * qy - py * qx], 1)


def advance_dahl_friction(state: Array, change: Array, threshold: float) -> Array:
    """Return the Dahl friction as a fraction of its limit after the strain has grown by ``change``.

    The law is z' = (k' - |k'| z) / threshold.
    """
    path = change / threshold
    decay = np.exp(-np.abs(path))
    return state * decay + np.sign(path) * (1 - decay)
