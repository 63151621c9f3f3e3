"""Kinematics of the triangles: mesh constants, deformation gradients, and sums over corners."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from .._utils.linalg import cross, dot
from ..types import Surface


class Geometry(NamedTuple):
    """Constants of the mesh, in the layout that a substep reads.

    With the edges d1 = x1 - x0 and d2 = x2 - x0 of a triangle, the columns of its deformation gradient are
    f1 = warp[0] d1 + warp[1] d2 and f2 = weft[0] d1 + weft[1] d2.

    Attributes:
        corners: [3 E] int64, vertices of the triangles: all first corners, then all second, then all third.
        warp: each [E, 1] 1/m, coefficients of f1.
        weft: each [E, 1] 1/m, coefficients of f2.
        area: [E, 1] m^2, rest area.
    """

    corners: Tensor
    warp: tuple[Tensor, Tensor]
    weft: tuple[Tensor, Tensor]
    area: Tensor

    @classmethod
    def from_shape_gradients(cls, corners: Tensor, gradient: Tensor, area: Tensor) -> Geometry:
        """Build from the gradients of the linear shape functions [E, 3, 2] 1/m."""
        g = gradient
        return cls(corners, (g[:, 1, 0:1], g[:, 2, 0:1]), (g[:, 1, 1:2], g[:, 2, 1:2]), area)


def surface(geometry: Geometry, x: Tensor, v: Tensor, compensation: Tensor | None = None) -> Surface:
    """Compute the kinematics of all triangles.

    Args:
        geometry: mesh constants.
        x: [..., V, 3] m, vertex positions.
        v: [..., V, 3] m/s, vertex velocities.
        compensation: [..., V, 3] m, rounding error of ``x`` (see ``substep.compensated_add``). Without it, float32
            edges at 1 m from the origin would strain by 1e-6, and stiff cloth would creep on a table.
    """
    x0, x1, x2 = corners(geometry, x)
    d1, d2 = x1 - x0, x2 - x0
    if compensation is not None:
        c0, c1, c2 = corners(geometry, compensation)
        d1, d2 = d1 + (c1 - c0), d2 + (c2 - c0)
    f1 = geometry.warp[0] * d1 + geometry.warp[1] * d2
    f2 = geometry.weft[0] * d1 + geometry.weft[1] * d2
    normal = cross(f1, f2)
    J = dot(normal, normal).sqrt()
    n = normal / J
    return Surface(f1, f2, cross(f2, n), cross(n, f1), n, J, geometry.area, centroids(geometry, v))


def corners(geometry: Geometry, field: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return a vertex field [..., V, K] at the first, second and third corner of each triangle, [..., E, K] each."""
    return field.index_select(-2, geometry.corners).unflatten(-2, (3, -1)).unbind(-3)  # type: ignore[return-value]


def centroids(geometry: Geometry, field: Tensor) -> Tensor:
    """Return the mean [..., E, K] of a vertex field [..., V, K] over the corners of each triangle."""
    a, b, c = corners(geometry, field)
    return (a + b + c) / 3


def assemble(geometry: Geometry, shares: tuple[Tensor, Tensor, Tensor], like: Tensor) -> Tensor:
    """Sum the shares [..., E, K] of the three corners on the vertices, [..., V, K].

    ``like`` has the shape of the result. Shares and ``like`` may each lack batch dimensions that the other has.
    """
    stacked = torch.cat(shares, dim=-2)
    stacked = stacked.expand(*torch.broadcast_shapes(stacked.shape[:-2], like.shape[:-2]), *stacked.shape[-2:])
    index = geometry.corners.unsqueeze(-1).expand(stacked.shape)  # scatter_add: 7 times faster than index_add here
    return torch.zeros_like(like).expand(*stacked.shape[:-2], -1, -1).scatter_add(-2, index, stacked)


def vertex_mass(geometry: Geometry, density: Tensor, vertex_area: Tensor) -> Tensor:
    """Compute lumped vertex masses [..., V, 1] kg.

    Args:
        geometry: mesh constants.
        density: areal density [...] or [..., E] kg/m^2.
        vertex_area: [V, 1] m^2, a third of each adjacent triangle.
    """
    if density.ndim == 0:
        return density * vertex_area
    triangle = density.unsqueeze(-1) * geometry.area / 3
    corner_mass = torch.cat([triangle] * 3, dim=-2)
    total = triangle.new_zeros(*triangle.shape[:-2], *vertex_area.shape)
    return total.index_add(-2, geometry.corners, corner_mass)
