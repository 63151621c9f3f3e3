"""Simulated episodes as functions of the unknowns, with forward-mode or reverse-mode derivatives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from operator import itemgetter
from typing import NamedTuple

import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor, nn

from .._utils.linalg import differentiate_hermite, interpolate_hermite
from ..cloth import Cloth
from ..errors import SimulationDiverged, UnstableStep
from ..parameters import call_with_parameters
from ..simulation.sensitivities import Directions
from ..types import ClothState, Rollout
from .observed import Episode
from .unknowns import Unknown, make_state_entries

SETTLE_TIME_S = 0.3  # in which the noise of measured positions is damped out
SIMULATIONS_PER_BATCH = 8  # float64 lanes of the widest packs


class Frames(NamedTuple):
    """What an observer sees of the cloth at an episode's T frames; or derivatives of it, with K in front.

    Attributes:
        x: [T, V, 3] m.
        v: [T, V, 3] m/s.
        wrench: gripper -> [T, 6] N, N m.
        rim_offset: [T] m, distance by which the rim seems farther out than it is.
    """

    x: Tensor
    v: Tensor
    wrench: dict[str, Tensor]
    rim_offset: Tensor


class StateModes(NamedTuple):
    """M directions in which the state at the first frame may change.

    Attributes:
        x: [M, V, 3] m per unit.
        v: [M, V, 3] m/s per unit.
    """

    x: Tensor
    v: Tensor


def first_state(cloth: Cloth, episode: Episode) -> ClothState:
    """Return the state at the first frame, before it settles where it does."""
    return cloth.state(episode.initial, episode.initial_velocity)


class Replay(nn.Module):
    """A cloth driven through an episode: it settles, unless it moves at the first frame, then follows the motion."""

    def __init__(self, cloth: Cloth) -> None:
        super().__init__()
        self.cloth = cloth

    def forward(self, episode: Episode, dt: float | None = None) -> Rollout:
        """Simulate the episode at its frame times."""
        state = first_state(self.cloth, episode)
        if episode.needs_settling:
            start = float(episode.times[0])
            state = self.cloth.settle(state, episode.motion, start=start, duration=SETTLE_TIME_S)
        return self.cloth(state, episode.motion, episode.times, dt=dt)


def simulate(
    cloth: Cloth, unknowns: Sequence[Unknown], raw: Tensor, episode: Episode, dt: float | None = None
) -> Frames:
    """Simulate the episode at the unknowns ``raw`` [K]; differentiable in reverse mode when ``raw`` requires grad."""
    values = make_state_entries(unknowns, raw)
    entries = {f"cloth.{key}": value.to(episode.initial) for key, value in values.items()}
    return frames_from_rollout(call_with_parameters(Replay(cloth), entries, (episode, dt)))


@torch.no_grad()
def simulate_all(
    cloth: Cloth, unknowns: Sequence[Unknown], raw: Tensor, episode: Episode, dt: float | None = None
) -> list[Frames | None]:
    """Simulate the episode at N points ``raw`` [N, K] of the unknowns; None where a simulation fails.

    Points share batches, whose substep is that of the stiffest one. So those with similar steps go together.
    """
    out: list[Frames | None] = [None] * len(raw)
    order = torch.tensor([_stable_step(cloth, unknowns, point) for point in raw]).argsort()
    for part in (order[first : first + SIMULATIONS_PER_BATCH] for first in range(0, len(raw), SIMULATIONS_PER_BATCH)):
        with suppress(SimulationDiverged, UnstableStep):
            frames = simulate(cloth, unknowns, raw[part][:, None], episode, dt)
            for k, i in enumerate(part.tolist()):
                out[i] = map_frames(frames, itemgetter(k))
            continue
        for i in part.tolist() if len(part) > 1 else ():  # one of them failed, and took the others along
            with suppress(SimulationDiverged, UnstableStep):
                out[i] = simulate(cloth, unknowns, raw[i], episode, dt)
    return out


def shared_step(cloth: Cloth, unknowns: Sequence[Unknown], raw: Tensor) -> float | None:
    """Return a substep [s] that is stable at all N points ``raw`` [N, K] where there is a stable one; else None."""
    steps = [_stable_step(cloth, unknowns, point) for point in raw]
    return min((step for step in steps if step > 0), default=None)


def _stable_step(cloth: Cloth, unknowns: Sequence[Unknown], raw: Tensor) -> float:
    """Return the stable substep [s] at a point; 0 where there is none."""
    entries = make_state_entries(unknowns, raw.to(cloth.areal_density.raw))
    values = {f"cloth.{key}": value for key, value in entries.items()}
    try:
        return call_with_parameters(_StableStep(cloth), values, ())
    except UnstableStep:
        return 0.0


class _StableStep(nn.Module):
    def __init__(self, cloth: Cloth) -> None:
        super().__init__()
        self.cloth = cloth

    def forward(self) -> float:
        return self.cloth.stable_step()


def simulate_with_tangents(
    cloth: Cloth,
    unknowns: Sequence[Unknown],
    raw: Tensor,
    episode: Episode,
    dt: float | None = None,
    modes: StateModes | None = None,
    by_unknowns: bool = True,
) -> tuple[Frames, Frames]:
    """Simulate the episode with exact derivatives, in one forward pass.

    Memory does not grow with the number of substeps.

    Args:
        cloth: the model.
        unknowns: K parameters.
        raw: [K] unconstrained values.
        episode: what drives the cloth.
        dt: largest substep [s]; None: the stable one.
        modes: changes of the first state along which there are derivatives, too.
        by_unknowns: whether there are derivatives by the unknowns; without them there must be modes.

    Returns:
        The frames, and their derivatives by the unknowns, then along the modes, [K + M, ...].
    """
    count, extra = len(unknowns) if by_unknowns else 0, 0 if modes is None else len(modes.x)
    value = raw.detach().to(episode.initial)
    directions = torch.eye(count + extra, len(unknowns), dtype=episode.initial.dtype)
    entries = {f"cloth.{key}": v for key, v in make_state_entries(unknowns, value).items()}
    along = Directions(make_state_entries(unknowns, directions) if by_unknowns else {})
    if modes is not None and extra:
        along = along._replace(state=initial_state_tangents(cloth, episode, modes, count))
    out, tangents = call_with_parameters(_ReplayWithTangents(cloth), entries, (episode, along, dt))
    return frames_from_rollout(out), frames_from_rollout(tangents)


class _ReplayWithTangents(nn.Module):
    def __init__(self, cloth: Cloth) -> None:
        super().__init__()
        self.cloth = cloth

    def forward(self, episode: Episode, along: Directions, dt: float | None) -> tuple[Rollout, Rollout]:
        state, settle = first_state(self.cloth, episode), SETTLE_TIME_S if episode.needs_settling else 0.0
        return self.cloth.sensitivities(state, episode.motion, episode.times, along=along, dt=dt, settle=settle)


def map_frames(frames: Frames, function: Callable[[Tensor], Tensor]) -> Frames:
    """Apply a function to every tensor of some frames."""
    wrench = {name: function(w) for name, w in frames.wrench.items()}
    return Frames(function(frames.x), function(frames.v), wrench, function(frames.rim_offset))


def see_at(frames: Frames, times: Tensor, shift: Tensor) -> Frames:
    """Return frames as they are ``shift`` after their times; also derivatives of frames, with K in front.

    Between the frames the cloth follows cubics through their velocities; outside of the frames it rests.

    Args:
        frames: at ``times``.
        times: [T] s.
        shift: [T], or [1] for all frames, s.
    """
    t = (times - times[0]).to(frames.x)
    x, v = (path(t, frames.x, frames.v, t + shift.to(t)) for path in (interpolate_hermite, differentiate_hermite))
    return frames._replace(x=x, v=v)


def frames_from_rollout(rollout: Rollout) -> Frames:
    """Return what an observer without errors sees of a rollout."""
    return Frames(rollout.x, rollout.v, rollout.wrench, rollout.x.new_zeros(rollout.x.shape[:-2]))


def initial_state_tangents(cloth: Cloth, episode: Episode, modes: StateModes, before: int) -> ClothState:
    """Compute tangents of the first state: ``before`` zero directions, then the M modes."""
    rest = first_state(cloth, episode)
    mode_tangents = []
    with torch.no_grad():
        for x, v in zip(modes.x, modes.v, strict=True):
            with forward_ad.dual_level():
                position = forward_ad.make_dual(rest.x, x.to(rest.x).contiguous())
                state = cloth.state(position, forward_ad.make_dual(rest.v, v.to(rest.x).contiguous()))
                mode_tangents.append(state.map(_tangent))
    zeros = rest.map(lambda field: field.new_zeros(before, *field.shape))

    def join(first: Tensor, *others: Tensor) -> Tensor:
        return torch.cat([first, *(t.unsqueeze(0) for t in others)])

    memory = {name: join(value, *(m.memory[name] for m in mode_tangents)) for name, value in zeros.memory.items()}
    x, v, d3 = (join(getattr(zeros, n), *(getattr(m, n) for m in mode_tangents)) for n in ("x", "v", "d3"))
    return ClothState(x, v, d3, memory)


def _tangent(field: Tensor) -> Tensor:
    tangent = forward_ad.unpack_dual(field).tangent
    return torch.zeros_like(field) if tangent is None else tangent.clone()
