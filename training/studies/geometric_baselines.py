"""Baselines without physics, from points alone and frame by frame, for comparison only."""

from __future__ import annotations

import torch
from torch import Tensor

from torchcloth.identification import Episode
from torchcloth.losses import find_closest_points
from torchcloth.meshes import Mesh
from torchcloth.observe.least_squares import Equations, expand_to_axes, solve_moves
from torchcloth.observe.shape_prior import ShapePrior

MATCHING_ROUNDS = 8  # of closest points
EDGE_STRAIN_STD = 0.01  # of the length prior
GRIP_STD_M = 1e-4  # of gripped vertices


def snap_to_points(frames: Tensor, episode: Episode, reach: float) -> Tensor:
    """Move each vertex to the nearest measured point within ``reach`` [m]; return [T, V, 3] m."""
    out = frames.clone()
    for t, cloud in enumerate(episode.clouds):
        if len(cloud):
            distance, index = torch.cdist(frames[t], cloud).min(1)
            out[t, distance < reach] = cloud[index[distance < reach]]
    return out


def register_frames(episode: Episode, mesh: Mesh, gripped: Tensor, gripped_positions: Tensor, noise: float) -> Tensor:
    """Register each frame non-rigidly, starting from an extrapolation of the two frames before.

    Points pull the surface along its normal, and in its plane if they lie beyond its boundary. Edges keep their
    length, curvature is small, and gripped vertices follow the grippers. This is ``observe.align`` without its search
    for a pose.

    Args:
        episode: clouds and first shape.
        mesh: of the cloth.
        gripped: [H] vertices.
        gripped_positions: [T, H, 3] m, their positions.
        noise: standard deviation of a point [m].

    Returns:
        [T, V, 3] m.
    """
    faces, frames_so_far = torch.as_tensor(mesh.faces), [episode.initial]
    prior = ShapePrior(mesh, episode.initial, EDGE_STRAIN_STD)
    for t, cloud in enumerate(episode.clouds[1:], 1):
        x = 2 * frames_so_far[-1] - frames_so_far[-2] if t > 1 else frames_so_far[-1].clone()
        for _ in range(MATCHING_ROUNDS):
            grip = expand_to_axes(
                gripped[:, None],
                x.new_ones(len(gripped), 1) / GRIP_STD_M,
                (gripped_positions[t] - x[gripped]) / GRIP_STD_M,
            )
            x = x + solve_moves([*_pulls(x, cloud, faces, noise), *grip, *prior.equations(x)], len(x))
        frames_so_far.append(x)
    return torch.stack(frames_so_far)


def _pulls(x: Tensor, cloud: Tensor, faces: Tensor, noise: float) -> list[Equations]:
    hits = find_closest_points(cloud, x, faces)
    a, b, c = x[hits.corners].unbind(1)
    normal = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)
    offset = cloud - hits.interpolate(x)
    along = (offset * normal).sum(-1)
    tangential = (offset - along[:, None] * normal)[hits.is_beyond_edge]
    size = tangential.norm(dim=-1).clamp(min=1e-12)
    boundary_rows = (
        hits.corners[hits.is_beyond_edge],
        hits.weights[hits.is_beyond_edge],
        tangential / size[:, None],
        size,
    )
    out = []
    for corners, weights, direction, value in ((hits.corners, hits.weights, normal, along), boundary_rows):
        coefficients = weights[:, :, None] * direction[:, None] / noise
        z = value / noise
        out.append(Equations(corners, coefficients, z).weighted(2.5 / z.abs().clamp(min=2.5)))
    return out
