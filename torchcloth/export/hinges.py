"""Hinges between triangles: how other engines bend a mesh, and the plate that they stand for.

Engines bend cloth by one spring per interior edge, of energy w theta^2 / 2 with the dihedral angle theta. Engines
differ in what w is, and in what a user sets. A plate of rigidity D that is rolled to a cylinder of curvature kappa has
the energy D kappa^2 / 2 per area, in every direction. Hinges have sum(w theta^2) / 2, and theta follows from the four
corners of each flap. So one factor on w makes the mean over all directions right.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

DIRECTION_COUNT = 24  # of cylinders, evenly over half a turn; angles enter the energy up to the fourth harmonic


@dataclass(frozen=True, eq=False)
class Hinges:
    """Interior edges of a mesh.

    Attributes:
        vertices: [N, 4], both ends of the edge, then the corners across it.
        length: [N] m, of the edge at rest.
        area: [N] m^2, of both triangles together.
        bend: [N, DIRECTION_COUNT] m, dihedral angle over curvature for cylinders in every direction.
    """

    vertices: np.ndarray
    length: np.ndarray
    area: np.ndarray
    bend: np.ndarray

    def rigidity(self, weight: np.ndarray) -> np.ndarray:
        """Return the plate rigidity [DIRECTION_COUNT] N m that hinges of stiffness ``weight`` [N] N m have."""
        tributary = self.area.sum() / 3  # a third of each triangle belongs to each of its edges
        return (weight[:, None] * self.bend**2).sum(0) / tributary


def find_hinges(rest: np.ndarray, faces: np.ndarray) -> Hinges:
    """Find the interior edges of triangles [F, 3] with vertices at rest at [V, 3] m.

    Directions are counted from x where the sheet lies in a plane of constant z, else from each edge.
    """
    sides = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    across = np.concatenate([faces[:, 2], faces[:, 0], faces[:, 1]])
    order = np.lexsort(np.sort(sides, axis=1).T)
    edges, across = np.sort(sides, axis=1)[order], across[order]
    first = np.flatnonzero((edges[1:] == edges[:-1]).all(1))
    vertices = np.column_stack([edges[first], across[first], across[first + 1]])
    a, b, c, d = (rest[vertices[:, k]] for k in range(4))
    length = np.linalg.norm(b - a, axis=1)
    along = (b - a) / length[:, None]
    flaps = [_lay_flat(corner - a, along) for corner in (c, d)]
    is_flat = np.ptp(rest[:, 2]) == 0
    turn = np.arctan2(along[:, 1], along[:, 0]) if is_flat else np.zeros(len(along))
    is_right = np.cross(b - a, c - a)[:, 2] < 0 if is_flat else np.zeros(len(along), bool)
    angle = np.pi * np.arange(DIRECTION_COUNT) / DIRECTION_COUNT - turn[:, None]
    angle = np.where(is_right[:, None], -angle, angle)
    # slope of a flap of z = (x cos + y sin)^2 / 2 away from the edge; the second one is at negative y
    total = 0.0
    for (x, y), side in zip(flaps, (1.0, -1.0), strict=True):
        height = 0.5 * (x[:, None] * np.cos(angle) + side * y[:, None] * np.sin(angle)) ** 2
        on_edge = 0.5 * (length * x)[:, None] * np.cos(angle) ** 2  # z of the straight edge at the foot of the corner
        total = total + (height - on_edge) / y[:, None]
    area = 0.5 * length * (flaps[0][1] + flaps[1][1])
    return Hinges(vertices, length, area, np.asarray(total))


def _lay_flat(corner: np.ndarray, along: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a corner's distances along the edge and from it, each [N] m."""
    x = (corner * along).sum(1)
    return x, np.linalg.norm(corner - x[:, None] * along, axis=1)
