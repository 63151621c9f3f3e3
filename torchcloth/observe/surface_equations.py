"""Least-squares equations that lay a surface on points."""

from __future__ import annotations

import torch
from torch import Tensor

from ..losses import find_closest_points
from .least_squares import Equations

POINT_HUBER_THRESHOLD = 2.5  # standard deviations beyond which a point counts linearly


def surface_equations(x: Tensor, points: Tensor, faces: Tensor, noise: float) -> list[Equations]:
    """Return equations, in standard deviations, that pull a surface to points.

    Points lie on the surface along its normal; those beyond its edge lie on it in its plane as well. Points far away
    count linearly (Huber).

    Args:
        x: [V, 3] m, vertices of the surface, at which the equations are linearised.
        points: [N, 3] m.
        faces: [F, 3], triangles that points may lie on.
        noise: m, standard deviation of a point.
    """
    hits = find_closest_points(points, x, faces)
    first, second, third = x[hits.corners].unbind(1)
    normal = torch.nn.functional.normalize(torch.linalg.cross(second - first, third - first), dim=-1)
    offset = points - hits.interpolate(x)
    normal_offset = (offset * normal).sum(-1)
    edge_offset = (offset - normal_offset.unsqueeze(-1) * normal)[hits.is_beyond_edge]
    size = edge_offset.norm(dim=-1)
    equations = []
    for corners, weights, direction, value in (
        (hits.corners, hits.weights, normal, normal_offset),
        (
            hits.corners[hits.is_beyond_edge],
            hits.weights[hits.is_beyond_edge],
            edge_offset / size.clamp_min(1e-12).unsqueeze(-1),
            size,
        ),
    ):
        z = value / noise
        linear = Equations(corners, weights.unsqueeze(-1) * direction.unsqueeze(1) / noise, z)
        equations.append(linear.weighted(POINT_HUBER_THRESHOLD / z.abs().clamp_min(POINT_HUBER_THRESHOLD)))
    return equations
