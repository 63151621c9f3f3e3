"""How far a simulated motion is from the clouds: residual rows, robust weights, and the figures that are reported."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor

from ..forward_mode import real_tangents
from ..losses import closest, residuals
from .episodes import Episode

HUBER = 1.5  # in units of the noise scale: quadratic below, linear above
EDGE_WEIGHT = 0.5  # of the in-plane rows: silhouettes are eroded by the sensor and by segmentation


class Figures(NamedTuple):
    """Reported distances [m]: one-sided, cloud to surface."""

    chamfer: float  # mean over frames of the mean over points
    rms: float
    per_frame: Tensor  # [T]


class Rows(NamedTuple):
    """Residual rows of all frames of one episode, normal rows first within each frame."""

    value: Tensor  # [R] m
    jacobian: Tensor | None  # [R, K] m per unit of the unconstrained parameters
    factor: Tensor  # [R] prior weight of the row
    frame: Tensor  # [R] int64


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


def rows(frames: Tensor, tangent: Tensor | None, episode: Episode, faces: Tensor) -> Rows:
    """Residuals of one episode, and their derivatives when ``tangent`` [K, T, V, 3] is given.

    The first frame is left out: it is where the simulation was started.
    """
    value, jacobian, factor, frame = [], [], [], []
    for t in range(1, len(episode.clouds)):
        cloud = episode.clouds[t]
        hits = closest(cloud, frames[t], faces)
        along, beside = residuals(cloud, frames[t], hits)
        edge = hits.beyond
        value += [along, beside[edge]]
        factor += [torch.ones_like(along), torch.full_like(beside[edge], EDGE_WEIGHT)]
        frame.append(torch.full((len(along) + int(edge.sum()),), t))
        if tangent is not None:
            with forward_ad.dual_level(), real_tangents():
                count = len(tangent)
                dual = forward_ad.make_dual(frames[t].expand(count, -1, -1).contiguous(), tangent[:, t].contiguous())
                by_normal, by_edge = (forward_ad.unpack_dual(r).tangent for r in residuals(cloud, dual, hits))
                jacobian += [by_normal.mT, by_edge[:, edge].mT]
    return Rows(
        torch.cat(value),
        torch.cat(jacobian) if jacobian else None,
        torch.cat(factor),
        torch.cat(frame),
    )


def noise_scale(value: Tensor, floor: float | None) -> float:
    """Robust standard deviation of residuals [m], not below the sensor's."""
    spread = 1.4826 * float(value.abs().median())
    return max(spread, floor or 0.0, 1e-6)


def huber(z: Tensor) -> tuple[Tensor, Tensor]:
    """(loss, weight) of standardised residuals; loss is z^2 / 2 near zero."""
    size = z.abs()
    inside = size <= HUBER
    loss = torch.where(inside, 0.5 * z * z, HUBER * (size - 0.5 * HUBER))
    return loss, torch.where(inside, torch.ones_like(z), HUBER / torch.where(inside, 1.0, size))
