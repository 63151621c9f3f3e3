"""Simulated episodes as functions of the unknowns, with forward-mode or reverse-mode derivatives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor, nn

from ..cloth import Cloth
from ..parameters import called
from ..simulation.sensitivities import Directions
from ..types import ClothState, Rollout
from .observed import Episode
from .unknowns import Unknown, overrides

SETTLING = 0.3  # s, in which the noise of measured positions is damped out


class Frames(NamedTuple):
    """What an observer has of the cloth at an episode's T frames; or derivatives of it, with K in front."""

    x: Tensor  # [T, V, 3] m
    v: Tensor  # [T, V, 3] m/s
    wrench: dict[str, Tensor]  # gripper -> [T, 6] N, N m
    edge: Tensor  # [T] m, by how much the rim seems farther out than it is


class Replay(nn.Module):
    """A cloth driven through an episode: settle, then follow the motion."""

    def __init__(self, cloth: Cloth) -> None:
        super().__init__()
        self.cloth = cloth

    def forward(self, episode: Episode, dt: float | None = None) -> Rollout:
        """The simulation at the frame times."""
        state = self.cloth.state(episode.initial)
        if episode.settles:
            state = self.cloth.settle(state, episode.motion, start=float(episode.times[0]), duration=SETTLING)
        return self.cloth(state, episode.motion, episode.times, dt=dt)


def simulate(
    cloth: Cloth, unknowns: Sequence[Unknown], raw: Tensor, episode: Episode, dt: float | None = None
) -> Frames:
    """The episode at the unknowns ``raw`` [K]; differentiable in reverse mode when ``raw`` requires grad."""
    entries = {f"cloth.{key}": value.to(episode.initial) for key, value in overrides(unknowns, raw).items()}
    return frames_of(called(Replay(cloth), entries, (episode, dt)))


def tangents(
    cloth: Cloth,
    unknowns: Sequence[Unknown],
    raw: Tensor,
    episode: Episode,
    dt: float | None = None,
    modes: Tensor | None = None,
) -> tuple[Frames, Frames]:
    """The episode and its derivatives by the unknowns, then along ``modes`` [M, V, 3] of the initial shape.

    Exact, in one forward pass; memory does not grow with the number of substeps.
    """
    extra = 0 if modes is None else len(modes)
    value = raw.detach().to(episode.initial)
    eye = torch.eye(len(unknowns) + extra, len(unknowns), dtype=episode.initial.dtype)
    entries = {f"cloth.{key}": v for key, v in overrides(unknowns, value).items()}
    along = Directions(overrides(unknowns, eye))
    if modes is not None and extra:
        along = along._replace(state=state_along(cloth, episode, modes, len(unknowns)))
    out, moved = called(_Tangents(cloth), entries, (episode, along, dt))
    return frames_of(out), frames_of(moved)


class _Tangents(nn.Module):
    """As ``Replay``, with derivatives."""

    def __init__(self, cloth: Cloth) -> None:
        super().__init__()
        self.cloth = cloth

    def forward(self, episode: Episode, along: Directions, dt: float | None) -> tuple[Rollout, Rollout]:
        """The rollout and its tangents."""
        state, settle = self.cloth.state(episode.initial), SETTLING if episode.settles else 0.0
        return self.cloth.sensitivities(state, episode.motion, episode.times, along=along, dt=dt, settle=settle)


def each(frames: Frames, function: Callable[[Tensor], Tensor]) -> Frames:
    """``function`` of every tensor."""
    wrench = {name: function(w) for name, w in frames.wrench.items()}
    return Frames(function(frames.x), function(frames.v), wrench, function(frames.edge))


def frames_of(rollout: Rollout) -> Frames:
    """What an observer without errors of its own has of a rollout."""
    return Frames(rollout.x, rollout.v, rollout.wrench, rollout.x.new_zeros(rollout.x.shape[:-2]))


def state_along(cloth: Cloth, episode: Episode, modes: Tensor, before: int) -> ClothState:
    """Tangents of the first state: ``before`` directions that leave it alone, then the modes."""
    rest = cloth.state(episode.initial)
    moved = []
    with torch.no_grad():
        for mode in modes:
            with forward_ad.dual_level():
                state = cloth.state(forward_ad.make_dual(rest.x, mode.to(rest.x).contiguous()))
                moved.append(state.map(_tangent))
    still = rest.map(lambda field: field.new_zeros(before, *field.shape))
    join = lambda a, *b: torch.cat([a, *(t.unsqueeze(0) for t in b)])  # noqa: E731
    memory = {name: join(value, *(m.memory[name] for m in moved)) for name, value in still.memory.items()}
    x, v, d3 = (join(getattr(still, n), *(getattr(m, n) for m in moved)) for n in ("x", "v", "d3"))
    return ClothState(x, v, d3, memory)


def _tangent(field: Tensor) -> Tensor:
    tangent = forward_ad.unpack_dual(field).tangent
    return torch.zeros_like(field) if tangent is None else tangent.clone()
