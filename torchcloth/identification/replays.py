"""Simulated episodes as functions of the unknowns, with forward-mode or reverse-mode derivatives."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor, nn
from torch.func import functional_call

from ..cloth import Cloth
from ..forward_mode import real_tangents
from .episodes import Episode
from .unknowns import Unknown, overrides


class Replay(nn.Module):
    """A cloth driven through an episode: settle, then follow the motion."""

    def __init__(self, cloth: Cloth) -> None:
        super().__init__()
        self.cloth = cloth

    def forward(self, episode: Episode, dt: float | None = None, copies: int = 0) -> Tensor:
        """Vertices at the frame times [T, V, 3] m, or [copies, T, V, 3]."""
        state = self.cloth.state(episode.initial)
        if copies:
            state = state.map(lambda field: field.expand(copies, *field.shape))
        if episode.settles:
            state = self.cloth.settle(state, episode.motion, start=float(episode.times[0]))
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

    The K directions run as a batch; memory does not grow with the number of substeps.
    """
    count = len(unknowns)
    value = raw.detach().to(episode.initial).expand(count, count).contiguous()
    with torch.no_grad(), forward_ad.dual_level(), real_tangents():
        dual = forward_ad.make_dual(value, torch.eye(count, dtype=value.dtype))
        entries = {f"cloth.{key}": v.unsqueeze(-1) for key, v in overrides(unknowns, dual).items()}
        frames = functional_call(Replay(cloth), entries, (episode, dt, count))
        primal, tangent = forward_ad.unpack_dual(frames)
        return primal[0].clone(), torch.zeros_like(primal) if tangent is None else tangent.clone()
