"""The state nearest to an estimate in which the cloth hardly stretches, so that a simulation can begin with it."""

from __future__ import annotations

import torch
from torch import Tensor

from ..meshes import Mesh
from ..observe.least_squares import Equations, expand_to_axes, solve_moves
from ..observe.shape_prior import ShapePrior
from ..observe.surface_equations import surface_equations

HANGING_STRAIN_STD = 0.005  # of a hanging cloth
STRAIN_RATE_STD_PER_S = 0.05
HELD_STD_M, HELD_SPEED_STD_M_PER_S = 2e-3, 0.02  # of held vertices, whose place and speed the robot reports
MIN_STD_M = 1e-3
POINT_STD_M = 4e-3  # of a depth camera's points
VERTICES_IN_COMMON = 10  # neighbours that share an error of the estimate, and count as one
VELOCITY_STD_M_PER_S = 0.2  # of an estimate from clouds
PROJECTION_ROUNDS = 6
VELOCITY_TIME_SCALE_S = 0.05  # turns velocities into displacements of a size that the solver expects


def make_consistent(
    mesh: Mesh, x: Tensor, v: Tensor, std: Tensor, gripped: Tensor, cloud: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the nearest positions and velocities in which edges keep their length and the cloth bends little.

    Errors of single vertices are strains of several per cent, and stiff cloth turns these into motion that no estimate
    recovers from. Distances are counted in standard deviations.

    Args:
        mesh: the cloth.
        x: [V, 3] m, estimated positions.
        v: [V, 3] m/s, estimated velocities.
        std: [V] m, standard deviation of a coordinate of ``x``.
        gripped: [H], indices of the vertices that grippers hold, whose positions are better known.
        cloud: [N, 3] m, points of the cloth, on which its surface lies.
    """
    start, count = x.detach().double(), len(x)
    points, faces = cloud.detach().double(), torch.as_tensor(mesh.faces)
    prior = ShapePrior(mesh, start, HANGING_STRAIN_STD)
    each = torch.arange(count)[:, None]
    weight = 1 / (VERTICES_IN_COMMON**0.5 * std.detach().double().clamp(min=MIN_STD_M)[:, None])
    weight[gripped] = 1 / HELD_STD_M
    position = start
    for _ in range(PROJECTION_ROUNDS):
        near = expand_to_axes(each, weight, (start - position) * weight)
        seen = surface_equations(position, points, faces, POINT_STD_M)
        position = position + solve_moves([*prior.equations(position), *near, *seen], count)
    speed = v.detach().double()
    length = (position[prior.edges[:, 1]] - position[prior.edges[:, 0]]) / prior.length[:, None]
    along = length / prior.length[:, None] / (STRAIN_RATE_STD_PER_S * VELOCITY_TIME_SCALE_S)
    relative = (speed[prior.edges[:, 1]] - speed[prior.edges[:, 0]]) * VELOCITY_TIME_SCALE_S
    rate = Equations(prior.edges, torch.stack([-along, along], dim=1), -(along * relative).sum(-1))
    weight = torch.full_like(weight, 1 / (VELOCITY_STD_M_PER_S * VELOCITY_TIME_SCALE_S))
    weight[gripped] = 1 / (HELD_SPEED_STD_M_PER_S * VELOCITY_TIME_SCALE_S)
    change = solve_moves([rate, *expand_to_axes(each, weight, torch.zeros_like(speed))], count)
    return position.to(x), (speed + change / VELOCITY_TIME_SCALE_S).to(v)
