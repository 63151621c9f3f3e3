"""Residuals with their derivatives, one row each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ...episodes.observed import Episode
from ...episodes.observed_surface import ObservedSurface
from ...episodes.replay import Frames
from ...losses import ClosestPoints, find_closest_points


class SimulatedEpisode(NamedTuple):
    """One simulated episode with its measurements.

    Attributes:
        frames: the simulation, as it is observed.
        derivatives: of ``frames`` by the unknowns, with K in front; None: not computed.
        episode: the measurements.
        surface: the cloth's surface as data see it.
        hits: nearest places on the surface of each cloud's points, by frame. The first frame has none, because the
            simulation starts there.
    """

    frames: Frames
    derivatives: Frames | None
    episode: Episode
    surface: ObservedSurface
    hits: dict[int, ClosestPoints]


def match_points(
    frames: Frames, derivatives: Frames | None, episode: Episode, surface: ObservedSurface
) -> SimulatedEpisode:
    """Find the places on the simulated surface that are nearest to the clouds' points."""
    clouds = {t: cloud for t, cloud in enumerate(episode.clouds) if t > 0 and len(cloud)}
    hits = {t: find_closest_points(cloud, frames.x[t], surface.faces) for t, cloud in clouds.items()}
    return SimulatedEpisode(frames, derivatives, episode, surface, hits)


class ResidualRows(NamedTuple):
    """Residuals of one kind: measured minus simulated.

    Attributes:
        residual: [R] m, N or N m.
        jacobian: [R, K] per unit of the unconstrained unknowns; None: not computed.
        frame: [R] int64.
        error_group: [R] int64, equal for rows that share their error: a part of the fabric, a piece of the rim, or an
            axis of a sensor.
    """

    residual: Tensor
    jacobian: Tensor | None
    frame: Tensor
    error_group: Tensor


def concatenate_rows(parts: Sequence[ResidualRows]) -> ResidualRows | None:
    """Concatenate rows; return None if there are none."""
    if not parts:
        return None
    jacobians = [p.jacobian for p in parts if p.jacobian is not None]
    return ResidualRows(
        torch.cat([p.residual for p in parts]),
        torch.cat(jacobians) if jacobians else None,
        torch.cat([p.frame for p in parts]),
        torch.cat([p.error_group for p in parts]),
    )
