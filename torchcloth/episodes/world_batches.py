"""Runs of worlds that differ in numbers only, as one batch: their scenes share the lanes of a core."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from operator import itemgetter
from typing import NamedTuple

import torch
from torch import Tensor

from .._utils.resume import digest
from ..cloth import Cloth
from ..parameters import call_with_parameters
from ..types import Trajectory
from .cloth_fingerprint import cloth_fingerprint_parts, is_library_part
from .observed import Episode
from .replay import SIMULATIONS_PER_BATCH, Frames, Replay, frames_from_rollout, map_frames
from .world import World, copy_cloth
from .world_cache import IMPOSSIBLE_WORLD_ERRORS, none_if_impossible


class WorldRun(NamedTuple):
    """One simulation that is wanted.

    Attributes:
        world: that is simulated.
        episode: that drives it.
        dt: largest substep [s]; None: the stable one.
        may_fail: whether a world that cannot be simulated has no frames; else it raises.
    """

    world: World
    episode: Episode
    dt: float | None = None
    may_fail: bool = False

    def simulate(self) -> Frames | None:
        """Simulate what an observer sees, alone; None where that is impossible and may be.

        Raises:
            SimulationDiverged: unless the run may fail.
            UnstableStep: unless the run may fail.
        """
        if not self.may_fail:
            return self.world.simulate_observed(self.episode, self.dt)
        return none_if_impossible(lambda: self.world.simulate_observed(self.episode, self.dt))


def group_runs(runs: Sequence[WorldRun]) -> list[list[int]]:
    """Return the indices of runs that can share a batch."""
    groups: dict[str, list[int]] = {}
    for k, run in enumerate(runs):
        groups.setdefault(_batch_key(run), []).append(k)
    size = SIMULATIONS_PER_BATCH
    return [group[first : first + size] for group in groups.values() for first in range(0, len(group), size)]


def simulate_group(runs: Sequence[WorldRun]) -> list[Frames | None]:
    """Simulate what observers see of the runs of a group; where one fails, each is simulated alone.

    Raises:
        SimulationDiverged: a run that may not fail.
        UnstableStep: a run that may not fail.
    """
    if len(runs) > 1:
        with suppress(*IMPOSSIBLE_WORLD_ERRORS):
            frames = _simulate_batch(runs)
            return [run.world.observe(f, run.episode) for run, f in zip(runs, frames, strict=True)]
    return [run.simulate() for run in runs]


def _batch_key(run: WorldRun) -> str:
    """Return what runs of a batch have in common: everything but scalar parameters, first states and poses.

    A user's part may keep numbers anywhere, so nothing but itself has its key.
    """
    cloth, episode = run.world.cloth, run.world.apply_motion(run.episode)
    scalars = set(map(id, _scalar_parameters(cloth).values()))
    parts = ["scalar" if id(part) in scalars else part for part in cloth_fingerprint_parts(cloth)]
    parts += [id(part) for part in cloth.modules() if not is_library_part(type(part))]
    motion = [part for name, m in episode.motion.items() for part in (name, m.t, m.closed, m.pose.shape)]
    state = [episode.needs_settling, episode.initial_velocity is None]
    return digest([*parts, *motion, *state, episode.times, run.dt])


def _scalar_parameters(cloth: Cloth) -> dict[str, Tensor]:
    """Return parameters that may have a value for each scene, by all their names."""
    return {name: p for name, p in cloth.named_parameters(remove_duplicate=False) if p.ndim == 0}


@torch.no_grad()
def _simulate_batch(runs: Sequence[WorldRun]) -> list[Frames]:
    """Simulate what happens in the runs of a group."""
    cloths, episodes = [run.world.cloth for run in runs], [run.world.apply_motion(run.episode) for run in runs]
    by_cloth, first = [_scalar_parameters(cloth) for cloth in cloths], episodes[0]
    stacked = {name: torch.stack([p[name] for p in by_cloth])[:, None] for name in by_cloth[0]}
    entries = {f"cloth.{name}": values for name, values in stacked.items() if not bool((values == values[0]).all())}
    motions = {name: _stack_poses([e.motion[name] for e in episodes]) for name in first.motion}
    velocities = [e.initial_velocity for e in episodes if e.initial_velocity is not None]
    episode = replace(
        first,
        motion=motions,
        initial=torch.stack([e.initial for e in episodes]),
        initial_velocity=torch.stack(velocities) if velocities else None,
    )
    cloth = copy_cloth(cloths[0])  # other threads may simulate the world's own, whose parameters must not change
    frames = frames_from_rollout(call_with_parameters(Replay(cloth), entries, (episode, runs[0].dt)))
    return [map_frames(frames, itemgetter(k)) for k in range(len(runs))]


def _stack_poses(trajectories: Sequence[Trajectory]) -> Trajectory:
    """Return trajectories with common times as one, with an axis of scenes where their poses differ."""
    first = trajectories[0]
    if all(torch.equal(t.pose, first.pose) for t in trajectories):
        return first
    return first._replace(pose=torch.stack([t.pose for t in trajectories]))
