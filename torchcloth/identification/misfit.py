"""How far a simulated motion is from the clouds: residual rows, robust weights, and the figures that are reported."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor

from ..forward_mode import real_tangents
from ..losses import closest, residuals
from ..meshes import Mesh
from .episodes import Episode

HUBER = 1.5  # in units of the noise scale: quadratic below, linear above
EDGE_WEIGHT = 0.5  # of the in-plane rows: silhouettes are eroded by the sensor and by segmentation


class Figures(NamedTuple):
    """Reported distances [m]: one-sided, cloud to surface."""

    chamfer: float  # mean over frames of the mean over points
    rms: float
    per_frame: Tensor  # [T]


class Rows(NamedTuple):
    """Residual rows of all frames of one episode: for each frame the N normal ones, then the N in-plane ones.

    A point has both rows whether it lies beyond the edge or not, so that rows keep their meaning between iterations.
    """

    value: Tensor  # [R] m
    jacobian: Tensor | None  # [R, K] m per unit of the unconstrained parameters
    factor: Tensor  # [R] prior weight of the row
    frame: Tensor  # [R] int64
    patch: Tensor  # [R] int64, part of the fabric that was hit


def figures(frames: Sequence[Tensor], episodes: Sequence[Episode], faces: Tensor) -> Figures:
    """Distances over all frames of all episodes; ``frames`` are [T, V, 3] m each."""
    mean, squares, count = [], 0.0, 0
    for x, episode in zip(frames, episodes, strict=True):
        for vertices, cloud in zip(x, episode.clouds, strict=True):
            offset = cloud - closest(cloud, vertices, faces).on(vertices)
            squared = (offset * offset).sum(-1)
            mean.append(squared.sqrt().mean())
            squares, count = squares + float(squared.sum()), count + len(cloud)
    per_frame = torch.stack(mean)
    return Figures(float(per_frame.mean()), (squares / count) ** 0.5, per_frame)


def rows(frames: Tensor, tangent: Tensor | None, episode: Episode, faces: Tensor, patches: Tensor) -> Rows:
    """Residuals of one episode, and their derivatives when ``tangent`` [K, T, V, 3] is given.

    The first frame is left out: it is where the simulation was started. ``patches`` [V] names each vertex's part of the
    fabric.
    """
    value, jacobian, factor, frame, patch = [], [], [], [], []
    for t in range(1, len(episode.clouds)):
        cloud = episode.clouds[t]
        hits = closest(cloud, frames[t], faces)
        along, beside = residuals(cloud, frames[t], hits)
        value += [along, beside]
        factor += [torch.ones_like(along), torch.full_like(beside, EDGE_WEIGHT)]
        frame.append(torch.full((2 * len(cloud),), t))
        patch.append(patches[hits.corners[:, 0]].repeat(2))
        if tangent is not None:
            with forward_ad.dual_level(), real_tangents():
                start = frames[t].expand(len(tangent), -1, -1).contiguous()
                dual = forward_ad.make_dual(start, tangent[:, t].contiguous())
                slopes = (forward_ad.unpack_dual(r).tangent for r in residuals(cloud, dual, hits))
                jacobian += [slope.mT for slope in slopes if slope is not None]
    return Rows(
        torch.cat(value),
        torch.cat(jacobian) if jacobian else None,
        torch.cat(factor),
        torch.cat(frame),
        torch.cat(patch),
    )


def patches_of(mesh: Mesh, across: int = 4) -> Tensor:
    """[V] int64, which of across x across parts of the fabric a vertex belongs to, along its principal axes."""
    rest = mesh.uv if mesh.uv is not None else mesh.vertices
    centred = rest - rest.mean(0)
    axes = np.linalg.svd(centred, full_matrices=False)[2][:2]
    place = centred @ axes.T
    low, high = place.min(0), place.max(0)
    cell = np.minimum((across * (place - low) / np.maximum(high - low, 1e-12)).astype(int), across - 1)
    return torch.as_tensor(cell[:, 0] * across + cell[:, 1])


def noise_scale(value: Tensor, floor: float | None) -> float:
    """Robust standard deviation of residuals [m], not below the sensor's."""
    seen = value[value != 0]
    spread = 1.4826 * float(seen.abs().median()) if len(seen) else 0.0
    return max(spread, floor or 0.0, 1e-6)


def huber(z: Tensor) -> tuple[Tensor, Tensor]:
    """(loss, weight) of standardised residuals; loss is z^2 / 2 near zero."""
    size = z.abs()
    inside = size <= HUBER
    loss = torch.where(inside, 0.5 * z * z, HUBER * (size - 0.5 * HUBER))
    return loss, torch.where(inside, torch.ones_like(z), HUBER / torch.where(inside, 1.0, size))
