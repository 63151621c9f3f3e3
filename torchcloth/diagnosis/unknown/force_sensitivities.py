"""Sensitivities of an episode to forces of unknown origin: tangents along given accelerations, window after window.

The forces act along the simulated motion. What they would change about themselves is left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ...cloth import Cloth
from ...episodes.observed import Episode
from ...episodes.replay import SETTLE_TIME_S, Frames, first_state, frames_from_rollout, map_frames
from ...episodes.world import ObservationTransform, World
from ...pose.objective import CORRECTION_STATE_KEY, add_correction_effect, concatenate_windows
from ...simulation.sensitivities import Directions
from ...types import ClothState
from ..data.binning import finite_differences

OBSERVATION_NUDGE = 1e-3  # of a direction, to differentiate observation transforms


class ForcePulses(NamedTuple):
    """K accelerations of the cloth, each constant within a window; those of the first window act while it settles, too.

    Attributes:
        windows: first and last frame of each window; the last frame is the first of the next window.
        fields: [W, K, V, 3] accelerations [m/s^2].
    """

    windows: Sequence[tuple[int, int]]
    fields: Tensor


def differentiate_pulses(
    world: World, episode: Episode, pulses: ForcePulses, dt: float | None = None
) -> tuple[Frames, Frames]:
    """Simulate an episode and its derivatives along force pulses, as an observer sees them.

    Args:
        world: the model's world.
        episode: the episode.
        pulses: K pulses.
        dt: substep [s]; None: the largest stable one.

    Returns:
        The frames, and their derivatives along the K pulses.
    """
    cloth = add_correction_effect(world.cloth)
    frames, derivatives = _simulate_tangents(cloth, world.apply_motion(episode), pulses, dt)
    for transform in world.observation_transforms:
        frames, derivatives = _transform_tangents(transform, frames, derivatives, episode)
    return frames, derivatives


def _simulate_tangents(cloth: Cloth, episode: Episode, pulses: ForcePulses, dt: float | None) -> tuple[Frames, Frames]:
    """Simulate window after window; a direction joins when it first acts."""
    count, state = pulses.fields.shape[1], first_state(cloth, episode)
    is_active = pulses.fields.abs().amax((2, 3)).cummax(0).values > 0
    is_active[:, 0] = True  # at least one
    was_active, tangent = torch.zeros(count, dtype=torch.bool), None
    frames, derivatives = [], []
    for w, (first, last) in enumerate(pulses.windows):
        index = is_active[w].nonzero().squeeze(1)
        tangent = _extend_tangent(state, tangent, was_active[index])
        along = Directions({CORRECTION_STATE_KEY: pulses.fields[w, index].to(state.x)}, tangent)
        settle = SETTLE_TIME_S if episode.needs_settling and w == 0 else 0.0
        times = episode.times[first : last + 1]
        rollout, tangents = cloth.sensitivities(state, episode.motion, times, along=along, dt=dt, settle=settle)
        state, tangent, was_active = rollout.state, tangents.state, is_active[w]
        frames.append(frames_from_rollout(rollout))
        derivatives.append(
            map_frames(
                frames_from_rollout(tangents),
                lambda d, at=index: d.new_zeros(count, *d.shape[1:]).index_copy(0, at, d),
            )
        )
    return concatenate_windows(frames), concatenate_windows(derivatives)


def _extend_tangent(state: ClothState, tangent: ClothState | None, was_active: Tensor) -> ClothState:
    """Return tangents of the state along all directions of ``was_active`` [K]; zero along the new ones."""
    zero = state.map(lambda t: t.new_zeros(len(was_active), *t.shape))
    if tangent is None:
        return zero
    index = was_active.nonzero().squeeze(1)

    def insert(target: Tensor, source: Tensor) -> Tensor:
        return target.index_copy(0, index, source)

    memory = {name: insert(value, tangent.memory[name]) for name, value in zero.memory.items()}
    x, v, d3 = (insert(getattr(zero, name), getattr(tangent, name)) for name in ("x", "v", "d3"))
    return ClothState(x, v, d3, memory)


def _transform_tangents(
    transform: ObservationTransform, frames: Frames, derivatives: Frames, episode: Episode
) -> tuple[Frames, Frames]:
    """Return the transformed frames, and their derivatives by finite differences."""
    observed, shifted = transform(frames, episode), []
    for k in range(len(derivatives.x)):
        wrench = {name: w + OBSERVATION_NUDGE * derivatives.wrench[name][k] for name, w in frames.wrench.items()}
        x, v, rim_offset = (
            getattr(frames, name) + OBSERVATION_NUDGE * getattr(derivatives, name)[k]
            for name in ("x", "v", "rim_offset")
        )
        shifted.append(transform(Frames(x, v, wrench, rim_offset), episode))
    return observed, finite_differences(observed, shifted, [OBSERVATION_NUDGE] * len(shifted))
