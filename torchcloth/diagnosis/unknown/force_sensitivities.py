"""How a force of unknown origin would move what is seen: tangents along given accelerations, stretch after stretch.

The forces are as they would be along the simulated motion; what they would change about themselves is left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ...cloth import Cloth
from ...episodes.observed import Episode
from ...episodes.replay import SETTLING, Frames, each, frames_of
from ...episodes.world import View, World
from ...pose.objective import CORRECTION, joined, pushable
from ...simulation.sensitivities import Directions
from ...types import ClothState
from ..data.binning import finite_differences

KEY = f"effects.{CORRECTION}.acceleration.raw"
NUDGE = 1e-3  # of a direction, by which views are differentiated


class ForcePulses(NamedTuple):
    """K accelerations of the cloth, each constant within a stretch of frames; the first also acts while it settles."""

    windows: Sequence[tuple[int, int]]  # first and last frame of each; the last is the first of the next
    fields: Tensor  # [W, K, V, 3] m/s^2


def differentiate_pulses(world: World, episode: Episode, pushes: ForcePulses, dt: float | None = None) -> tuple[Frames, Frames]:
    """(what an observer has of the episode, its derivatives along the K pushes)."""
    frames, moved = _tangents(pushable(world.cloth), world.driven(episode), pushes, dt)
    for view in world.views:
        frames, moved = _viewed(view, frames, moved, episode)
    return frames, moved


def _tangents(cloth: Cloth, episode: Episode, pushes: ForcePulses, dt: float | None) -> tuple[Frames, Frames]:
    """Directions join in when they first push."""
    count, state = pushes.fields.shape[1], cloth.state(episode.initial)
    begun = pushes.fields.abs().amax((2, 3)).cummax(0).values > 0
    begun[:, 0] = True  # one at least
    before, moved, parts, ways = torch.zeros(count, dtype=torch.bool), None, [], []
    for w, (first, last) in enumerate(pushes.windows):
        index = begun[w].nonzero().squeeze(1)
        moved = _grown(state, moved, before[index])
        along = Directions({KEY: pushes.fields[w, index].to(state.x)}, moved)
        settle = SETTLING if episode.needs_settling and w == 0 else 0.0
        times = episode.times[first : last + 1]
        out, way = cloth.sensitivities(state, episode.motion, times, along=along, dt=dt, settle=settle)
        state, moved, before = out.state, way.state, begun[w]
        parts.append(frames_of(out))
        ways.append(each(frames_of(way), lambda d, at=index: d.new_zeros(count, *d.shape[1:]).index_copy(0, at, d)))
    return joined(parts), joined(ways)


def _grown(state: ClothState, moved: ClothState | None, known: Tensor) -> ClothState:
    """Tangents of the state along all directions of ``known`` [K]; zero along those that are new."""
    blank = state.map(lambda t: t.new_zeros(len(known), *t.shape))
    if moved is None:
        return blank
    at = known.nonzero().squeeze(1)
    spread = lambda a, b: a.index_copy(0, at, b)  # noqa: E731
    memory = {name: spread(value, moved.memory[name]) for name, value in blank.memory.items()}
    x, v, d3 = (spread(getattr(blank, n), getattr(moved, n)) for n in ("x", "v", "d3"))
    return ClothState(x, v, d3, memory)


def _viewed(view: View, frames: Frames, moved: Frames, episode: Episode) -> tuple[Frames, Frames]:
    """What is seen, and its derivatives by finite steps."""
    seen, tried = view(frames, episode), []
    for k in range(len(moved.x)):
        tried.append(view(_added(frames, moved, k), episode))
    return seen, finite_differences(seen, tried, [NUDGE] * len(tried))


def _added(frames: Frames, moved: Frames, k: int) -> Frames:
    wrench = {name: w + NUDGE * moved.wrench[name][k] for name, w in frames.wrench.items()}
    x, v, edge = (getattr(frames, n) + NUDGE * getattr(moved, n)[k] for n in ("x", "v", "edge"))
    return Frames(x, v, wrench, edge)
