"""A prior of a cloth's shape: edges keep their length, the cloth bends little, and layers stay together."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ..meshes import Mesh
from .least_squares import Equations, expand_to_axes

MAX_HINGE_ANGLE_RAD = np.pi / 3  # sharper edges of the placement are folds, and their angle is free
LAYER_DISTANCE_RATIO = 0.6  # of the mean edge length; vertices of other parts that are nearer lie on each other
LAYER_DISTANCE_STD_M = 0.005  # of the distance between layers
CURVATURE_STD_PER_M = 5.0  # of a cloth's curvature, averaged over an edge


class ShapePrior:
    """Least-squares equations, in standard deviations, for the vertices of a mesh.

    Args:
        mesh: the cloth.
        start: [V, 3] m, placement of the vertices whose shape is the prior's mean.
        strain: standard deviation of the strain of an edge.
    """

    def __init__(self, mesh: Mesh, start: Tensor, strain: float) -> None:
        self.strain = strain
        self.start = start
        edges, length = _edges(mesh)
        self.edges, self.length = torch.as_tensor(edges), torch.as_tensor(length)
        corners, weights, angle = _hinges(mesh, start.numpy())
        self.corners, self.weights = torch.as_tensor(corners), torch.as_tensor(weights / angle[:, None])
        self.pairs = torch.as_tensor(_layers(start.numpy(), edges, LAYER_DISTANCE_RATIO * mesh.mean_edge))

    def edge_strain(self, x: Tensor) -> Tensor:
        """Return the strain [N] of the edges."""
        return (x[self.edges[:, 1]] - x[self.edges[:, 0]]).norm(dim=-1) / self.length - 1

    def local_rotations(self, x: Tensor) -> Tensor:
        """Return the best rotations [V, 3, 3] of each vertex's edges from the start (Sorkine and Alexa 2007)."""
        i, j = torch.cat([self.edges, self.edges.flip(1)]).T
        outer = (x[j] - x[i]).unsqueeze(-1) * (self.start[j] - self.start[i]).unsqueeze(-2)
        U, _, Vh = torch.linalg.svd(x.new_zeros(len(x), 3, 3).index_add(0, i, outer))
        sign = x.new_ones(len(x), 1, 3)
        sign[:, 0, 2] = torch.linalg.det(U @ Vh)
        return (U * sign) @ Vh

    def equations(self, x: Tensor) -> list[Equations]:
        """Return the equations linearised at ``x`` [V, 3] m; offsets between layers turn with the vertices."""
        i, j = self.edges.T
        along = (x[j] - x[i]) / (self.length * (1 + self.edge_strain(x))).unsqueeze(-1)
        pull = along / (self.length * self.strain).unsqueeze(-1)
        bend = (self.weights.unsqueeze(-1) * x[self.corners]).sum(1)
        upper, lower = self.pairs.T
        offset = self.start[lower] - self.start[upper]
        offset = (self.local_rotations(x)[upper] @ offset.unsqueeze(-1)).squeeze(-1)
        return [
            Equations(self.edges, torch.stack([-pull, pull], dim=1), -self.edge_strain(x) / self.strain),
            *expand_to_axes(self.corners, self.weights, -bend),
            *expand_to_axes(
                self.pairs,
                x.new_tensor([-1.0, 1.0]) / LAYER_DISTANCE_STD_M,
                (offset - x[lower] + x[upper]) / LAYER_DISTANCE_STD_M,
            ),
        ]


def _edges(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Edges [N, 2] and their rest lengths [N] m."""
    sides = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    length = np.linalg.norm(mesh.rest[:, [1, 2, 0]] - mesh.rest, axis=-1).ravel()
    edges, first = np.unique(sides, axis=0, return_index=True)
    return edges, length[first]


def _hinges(mesh: Mesh, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the bending equations of neighbouring triangles abc and bad.

    The angle is the distance of d from the plane of abc over its height above the edge ab. Shapes come from ``rest``.

    Returns:
        Corners a, b, c, d [N, 4], weights [N, 4] 1/m of the angle, and its standard deviation [N] rad.
    """
    # edge (a, b) -> opposite corner c, foot of its height as a fraction of the edge from a, height [m]
    opposite: dict[tuple[int, int], tuple[int, float, float]] = {}
    for face, rest in zip(mesh.faces.tolist(), mesh.rest, strict=True):
        for k in range(3):
            edge, rim = rest[(k + 1) % 3] - rest[k], rest[(k + 2) % 3] - rest[k]
            length = float(np.linalg.norm(edge))
            foot, height = float(rim @ edge) / length**2, float(edge[0] * rim[1] - edge[1] * rim[0]) / length
            opposite[face[k], face[(k + 1) % 3]] = (face[(k + 2) % 3], foot, height)
    corners, weights, angle = [], [], []
    for (a, b), (c, foot_c, height_c) in opposite.items():
        if a < b and (b, a) in opposite:
            d, foot_d, height_d = opposite[b, a]
            foot_d = 1 - foot_d  # from a, as foot_c
            corners.append((a, b, c, d))
            weight_a = (foot_d - 1) / height_d + (foot_c - 1) / height_c
            weight_b = -foot_d / height_d - foot_c / height_c
            weights.append((weight_a, weight_b, 1 / height_c, 1 / height_d))
            angle.append(CURVATURE_STD_PER_M * (height_c + height_d) / 3)
    if not corners:
        return np.zeros((0, 4), int), np.zeros((0, 4)), np.zeros(0)
    vertices, coefficients, std = np.array(corners), np.array(weights), np.array(angle)
    size = np.linalg.norm((coefficients[..., None] * x[vertices]).sum(1), axis=-1)
    is_smooth = size < 2 * np.sin(MAX_HINGE_ANGLE_RAD / 2)
    return vertices[is_smooth], coefficients[is_smooth], std[is_smooth]


def _layers(x: np.ndarray, edges: np.ndarray, near: float) -> np.ndarray:
    """Pairs [N, 2] of vertices that lie on each other without an edge, or a vertex, between them."""
    distance = np.linalg.norm(x[:, None] - x[None], axis=-1)
    np.fill_diagonal(distance, np.inf)
    distance[edges[:, 0], edges[:, 1]] = distance[edges[:, 1], edges[:, 0]] = np.inf
    nearest = distance.argmin(1)
    i = np.flatnonzero(distance[np.arange(len(x)), nearest] < near)
    return np.unique(np.sort(np.stack([i, nearest[i]], axis=1), axis=1), axis=0).reshape(-1, 2)
