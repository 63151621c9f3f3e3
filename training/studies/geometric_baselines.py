"""What one does without physics: points alone, frame by frame. For comparison only."""

from __future__ import annotations

import torch
from torch import Tensor

from torchcloth.identification import Episode
from torchcloth.losses import find_closest_points
from torchcloth.meshes import Mesh
from torchcloth.observe.least_squares import Equations, expand_to_axes, solve_moves
from torchcloth.observe.shape_prior import ShapePrior

ROUNDS, STRAIN = 8, 0.01  # of matching points anew; standard deviation of the strain of an edge
FAST = 1e-4  # m, how well a held vertex is known


def snapped(frames: Tensor, episode: Episode, reach: float) -> Tensor:
    """[T, V, 3] m: every vertex moved to the measured point that is nearest to it, where one is within reach [m]."""
    out = frames.clone()
    for t, cloud in enumerate(episode.clouds):
        if len(cloud):
            distance, index = torch.cdist(frames[t], cloud).min(1)
            out[t, distance < reach] = cloud[index[distance < reach]]
    return out


def registered(episode: Episode, mesh: Mesh, held: Tensor, places: Tensor, noise: float) -> Tensor:
    """[T, V, 3] m: a non-rigid registration of every frame, begun where the two before it lead.

    Points pull the surface along its normal, and in its plane where they lie beyond its rim; edges keep their length,
    curvature is small, held vertices are where the grippers have them: ``observe.align`` without its search for a pose.

    Args:
        episode: clouds, first shape.
        mesh: the cloth.
        held: [H] vertices.
        places: [T, H, 3] m, where these are.
        noise: standard deviation of a point [m].
    """
    faces, found = torch.as_tensor(mesh.faces), [episode.initial]
    prior = ShapePrior(mesh, episode.initial, STRAIN)
    for t, cloud in enumerate(episode.clouds[1:], 1):
        x = 2 * found[-1] - found[-2] if t > 1 else found[-1].clone()
        for _ in range(ROUNDS):
            grip = expand_to_axes(held[:, None], x.new_ones(len(held), 1) / FAST, (places[t] - x[held]) / FAST)
            x = x + solve_moves([*_pulls(x, cloud, faces, noise), *grip, *prior.equations(x)], len(x))
        found.append(x)
    return torch.stack(found)


def _pulls(x: Tensor, cloud: Tensor, faces: Tensor, noise: float) -> list[Equations]:
    hits = find_closest_points(cloud, x, faces)
    a, b, c = x[hits.corners].unbind(1)
    normal = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)
    offset = cloud - hits.interpolate(x)
    along = (offset * normal).sum(-1)
    beside = (offset - along[:, None] * normal)[hits.is_beyond_edge]
    size = beside.norm(dim=-1).clamp(min=1e-12)
    rim = hits.corners[hits.is_beyond_edge], hits.weights[hits.is_beyond_edge], beside / size[:, None], size
    out = []
    for corners, weights, direction, value in ((hits.corners, hits.weights, normal, along), rim):
        coefficients = weights[:, :, None] * direction[:, None] / noise
        z = value / noise
        out.append(Equations(corners, coefficients, z).weighted(2.5 / z.abs().clamp(min=2.5)))
    return out
