"""Simulated episodes as functions of the unknowns, with forward-mode or reverse-mode derivatives."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.func import functional_call

from ..cloth import Cloth
from ..sensitivities import Directions
from ..types import Rollout
from .episodes import Episode
from .unknowns import Unknown, overrides

SETTLING = 0.3  # s, in which the noise of measured positions is damped out


class Replay(nn.Module):
    """A cloth driven through an episode: settle, then follow the motion."""

    def __init__(self, cloth: Cloth) -> None:
        super().__init__()
        self.cloth = cloth

    def forward(self, episode: Episode, dt: float | None = None) -> Tensor:
        """Vertices at the frame times [T, V, 3] m."""
        state = self.cloth.state(episode.initial)
        if episode.settles:
            state = self.cloth.settle(state, episode.motion, start=float(episode.times[0]), duration=SETTLING)
        return self.cloth(state, episode.motion, episode.times, dt=dt).x


def simulate(
    cloth: Cloth, unknowns: Sequence[Unknown], raw: Tensor, episode: Episode, dt: float | None = None
) -> Tensor:
    """Frames [T, V, 3] m at the unknowns ``raw`` [K]; differentiable in reverse mode when ``raw`` requires grad."""
    entries = {f"cloth.{key}": value.to(episode.initial) for key, value in overrides(unknowns, raw).items()}
    return functional_call(Replay(cloth), entries, (episode, dt))


def tangents(
    cloth: Cloth, unknowns: Sequence[Unknown], raw: Tensor, episode: Episode, dt: float | None = None
) -> tuple[Tensor, Tensor]:
    """Frames [T, V, 3] m and their derivatives [K, T, V, 3] by the unknowns, exact, in one forward pass.

    Memory does not grow with the number of substeps.
    """
    count = len(unknowns)
    value, eye = raw.detach().to(episode.initial), torch.eye(count, dtype=episode.initial.dtype)
    entries = {f"cloth.{key}": v for key, v in overrides(unknowns, value).items()}
    along = Directions({key: v for key, v in overrides(unknowns, eye).items()})
    out, moved = functional_call(_Tangents(cloth), entries, (episode, along, dt))
    return out.x, moved.x


class _Tangents(nn.Module):
    """As ``Replay``, with derivatives."""

    def __init__(self, cloth: Cloth) -> None:
        super().__init__()
        self.cloth = cloth

    def forward(self, episode: Episode, along: Directions, dt: float | None) -> tuple[Rollout, Rollout]:
        """The rollout and its tangents."""
        state, settle = self.cloth.state(episode.initial), SETTLING if episode.settles else 0.0
        return self.cloth.sensitivities(state, episode.motion, episode.times, along=along, dt=dt, settle=settle)
