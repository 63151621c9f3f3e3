"""Distances of a simulated motion from the data, as they are reported, and robust weights."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ...episodes.observed import Episode
from ...losses import find_closest_points

HUBER_THRESHOLD = 1.5  # noise scales: the loss is quadratic below, linear above
MIN_NOISE_SCALE = 1e-6  # m, N or N m: a perfect fit must not divide by zero
MAD_TO_STD = 1.4826  # standard deviation over median absolute value of a normal distribution


class DistanceMetrics(NamedTuple):
    """Reported one-sided distances, cloud to surface; NaN where there are no points.

    Attributes:
        chamfer: mean over frames of the mean over points [m].
        rms: root mean square over all points [m].
        per_frame: [T] m, mean distance in the frames that have points.
    """

    chamfer: float
    rms: float
    per_frame: Tensor


def distance_metrics(frames: Sequence[Tensor], episodes: Sequence[Episode], faces: Tensor) -> DistanceMetrics:
    """Compute distances over all frames of all episodes.

    Args:
        frames: [T, V, 3] m, simulated vertices of each episode.
        episodes: the measurements.
        faces: [F, 3].
    """
    means, square_sum, count = [], 0.0, 0
    for x, episode in zip(frames, episodes, strict=True):
        for t, vertices in enumerate(x):
            cloud = episode.observed_points(t)
            if len(cloud) == 0:
                continue
            offset = cloud - find_closest_points(cloud, vertices, faces).interpolate(vertices)
            squared = (offset * offset).sum(-1)
            means.append(squared.sqrt().mean())
            square_sum, count = square_sum + float(squared.sum()), count + len(cloud)
    if count == 0:
        return DistanceMetrics(math.nan, math.nan, torch.empty(0))
    per_frame = torch.stack(means)
    return DistanceMetrics(float(per_frame.mean()), (square_sum / count) ** 0.5, per_frame)


def force_rms(wrenches: Sequence[Mapping[str, Tensor]], episodes: Sequence[Episode]) -> float:
    """Compute the root mean square error [N] of simulated forces over all readings; NaN without readings."""
    squares = [
        (simulated[name] - measured)[1:, :3].square().sum(-1)
        for simulated, episode in zip(wrenches, episodes, strict=True)
        for name, measured in episode.wrenches.items()
    ]
    all_squares = torch.cat(squares) if squares else torch.empty(0)
    return float(all_squares[all_squares.isfinite()].mean().sqrt())


def noise_scale(residual: Tensor, floor: float | None) -> float:
    """Estimate the standard deviation of residuals from their median, not below the sensor's ``floor``."""
    observed = residual[residual != 0]
    scale = MAD_TO_STD * float(observed.abs().median()) if len(observed) else 0.0
    return max(scale, floor or 0.0, MIN_NOISE_SCALE)


def huber(z: Tensor, cutoff: Tensor | float = float("inf")) -> tuple[Tensor, Tensor]:
    """Compute (loss, weight) of standardised residuals.

    The loss is z^2 / 2 up to the threshold, linear beyond it, and constant beyond the cutoff.
    """
    size = z.abs()
    is_quadratic, is_counted = size <= HUBER_THRESHOLD, size <= cutoff
    linear_loss = HUBER_THRESHOLD * (size.clamp(max=cutoff) - 0.5 * HUBER_THRESHOLD)
    loss = torch.where(is_quadratic, 0.5 * z * z, linear_loss)
    weight = torch.where(is_quadratic, torch.ones_like(z), HUBER_THRESHOLD / torch.where(is_quadratic, 1.0, size))
    return loss, torch.where(is_counted, weight, torch.zeros_like(z))
