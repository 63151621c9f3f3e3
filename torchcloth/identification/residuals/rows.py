"""Residuals with their derivatives, one row each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ...episodes.observed import Episode
from ...episodes.observed_surface import Sheet
from ...episodes.replay import Frames
from ...losses import Hits, closest


class Scene(NamedTuple):
    """One simulated episode beside what was measured."""

    seen: Frames
    moved: Frames | None  # derivatives
    episode: Episode
    sheet: Sheet
    hits: dict[int, Hits]  # of the clouds, by frame; not of the first frame, where the simulation was started


def scene_of(seen: Frames, moved: Frames | None, episode: Episode, sheet: Sheet) -> Scene:
    """With the places on the surface that the clouds' points are nearest to."""
    clouds = {t: cloud for t, cloud in enumerate(episode.clouds) if t > 0 and len(cloud)}
    hits = {t: closest(cloud, seen.x[t], sheet.faces) for t, cloud in clouds.items()}
    return Scene(seen, moved, episode, sheet, hits)


class Rows(NamedTuple):
    """Residuals of one kind: measured minus simulated."""

    value: Tensor  # [R] m, N or N m
    jacobian: Tensor | None  # [R, K] per unit of the unconstrained unknowns
    frame: Tensor  # [R] int64
    patch: Tensor  # [R] int64, what errs together: a part of the fabric, a piece of the rim, an axis of a sensor


def joined(parts: Sequence[Rows]) -> Rows | None:
    """One after the other; None if there are none."""
    if not parts:
        return None
    jacobians = [p.jacobian for p in parts if p.jacobian is not None]
    value, frame, patch = (torch.cat([getattr(p, name) for p in parts]) for name in ("value", "frame", "patch"))
    return Rows(value, torch.cat(jacobians) if jacobians else None, frame, patch)
