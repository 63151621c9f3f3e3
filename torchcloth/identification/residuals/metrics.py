"""How far a simulated motion is from what was seen: the figures that are reported, and robust weights."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ...episodes.observed import Episode
from ...losses import closest

HUBER = 1.5  # in units of the noise scale: quadratic below, linear above
LEAST_SCALE = 1e-6  # m, N, N m: a perfect fit must not divide by zero


class Figures(NamedTuple):
    """Reported distances [m]: one-sided, cloud to surface. NaN where nothing was seen."""

    chamfer: float  # mean over frames of the mean over points
    rms: float
    per_frame: Tensor  # [T], of the frames that have points


def figures(frames: Sequence[Tensor], episodes: Sequence[Episode], faces: Tensor) -> Figures:
    """Distances over all frames of all episodes; ``frames`` are [T, V, 3] m each."""
    mean, squares, count = [], 0.0, 0
    for x, episode in zip(frames, episodes, strict=True):
        for t, vertices in enumerate(x):
            cloud = episode.positions(t)
            if len(cloud) == 0:
                continue
            offset = cloud - closest(cloud, vertices, faces).on(vertices)
            squared = (offset * offset).sum(-1)
            mean.append(squared.sqrt().mean())
            squares, count = squares + float(squared.sum()), count + len(cloud)
    if count == 0:
        return Figures(math.nan, math.nan, torch.empty(0))
    per_frame = torch.stack(mean)
    return Figures(float(per_frame.mean()), (squares / count) ** 0.5, per_frame)


def forces_rms(wrenches: Sequence[Mapping[str, Tensor]], episodes: Sequence[Episode]) -> float:
    """Root mean square distance [N] of forces from the measured ones, over all readings; NaN without readings."""
    missed = [
        (own[name] - measured)[1:, :3].square().sum(-1)
        for own, episode in zip(wrenches, episodes, strict=True)
        for name, measured in episode.wrenches.items()
    ]
    seen = torch.cat(missed) if missed else torch.empty(0)
    return float(seen[seen.isfinite()].mean().sqrt())


def noise_scale(value: Tensor, floor: float | None) -> float:
    """Robust standard deviation of residuals, not below the sensor's."""
    seen = value[value != 0]
    spread = 1.4826 * float(seen.abs().median()) if len(seen) else 0.0
    return max(spread, floor or 0.0, LEAST_SCALE)


def huber(z: Tensor, gate: Tensor | float = float("inf")) -> tuple[Tensor, Tensor]:
    """(loss, weight) of standardised residuals; z^2 / 2 near zero, linear beyond, constant beyond the gate."""
    size = z.abs()
    inside, counted = size <= HUBER, size <= gate
    loss = torch.where(inside, 0.5 * z * z, HUBER * (size.clamp(max=gate) - 0.5 * HUBER))
    weight = torch.where(inside, torch.ones_like(z), HUBER / torch.where(inside, 1.0, size))
    return loss, torch.where(counted, weight, torch.zeros_like(z))
