"""Baselines without physics, from points alone and frame by frame, for comparison only."""

from __future__ import annotations

import torch
from torch import Tensor

from torchcloth.identification import Episode
from torchcloth.meshes import Mesh
from torchcloth.observe.least_squares import expand_to_axes, solve_moves
from torchcloth.observe.shape_prior import ShapePrior
from torchcloth.observe.surface_equations import surface_equations

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
            x = x + solve_moves([*surface_equations(x, cloud, faces, noise), *grip, *prior.equations(x)], len(x))
        frames_so_far.append(x)
    return torch.stack(frames_so_far)
