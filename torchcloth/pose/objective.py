"""Residuals of a simulation with a small corrective force, window by window, that keeps it near the data."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor, nn

from ..cloth import Cloth
from ..effects import BodyForce
from ..episodes.observed import Episode
from ..episodes.replay import (
    SETTLE_TIME_S,
    Frames,
    first_state,
    frames_from_rollout,
    initial_state_tangents,
    map_frames,
)
from ..episodes.unknowns import Unknown, make_state_entries
from ..errors import InvalidInput, SimulationDiverged
from ..identification.estimators import levenberg_marquardt
from ..identification.estimators.objective import Objective
from ..identification.nuisances import AbstractNuisance
from ..identification.residuals.blocks import Block
from ..identification.residuals.metrics import distance_metrics
from ..parameters import call_with_parameters
from ..simulation.sensitivities import Directions
from ..types import ClothState, Rollout

CORRECTION_EFFECT_NAME = "correction"  # of the effect in the model
CORRECTION_STATE_KEY = f"effects.{CORRECTION_EFFECT_NAME}.acceleration.raw"


class CorrectiveForce(NamedTuple):
    """Where and when the cloth may be pushed.

    Attributes:
        windows: first and last frame of each window; the last one is the first of the next window.
        modes: [M, V] smooth fields.
        mode_std: [M] m/s^2, standard deviation of the prior of every number of a mode.
    """

    windows: list[tuple[int, int]]
    modes: Tensor
    mode_std: Tensor

    @property
    def count(self) -> int:
        """Number of unknowns: windows, modes, axes."""
        return len(self.windows) * self.count_per_window

    @property
    def count_per_window(self) -> int:
        """Number of unknowns of one window."""
        return 3 * len(self.modes)

    @property
    def number_stds(self) -> Tensor:
        """[count] m/s^2, standard deviation of every unknown's prior."""
        return self.mode_std.repeat_interleave(3).repeat(len(self.windows))

    def acceleration_field(self, numbers: Tensor) -> Tensor:
        """Return the acceleration [W, V, 3] m/s^2 from unknowns [count]."""
        return torch.einsum("wmc,mv->wvc", numbers.unflatten(0, (len(self.windows), -1, 3)), self.modes.to(numbers))


def split_into_windows(times: Tensor, length: float) -> list[tuple[int, int]]:
    """Return windows of about ``length`` [s] that cover all frames, at least one frame interval each."""
    duration = float(times[-1] - times[0])
    if length < 0.5 * float(times.diff().min()):  # one for each interval, not as many as so small a length asks for
        return list(pairwise(range(len(times))))
    targets = torch.linspace(0.0, duration, max(1, round(duration / length)) + 1, dtype=times.dtype).to(times)
    ends = (times[None] - times[0] - targets[:, None]).abs().argmin(1).unique().tolist()
    return list(pairwise(ends))


def add_correction_effect(cloth: Cloth) -> Cloth:
    """Return a copy of a cloth with one more effect, a body force of zero.

    Raises:
        InvalidInput: it has an effect of this name already.
    """
    if CORRECTION_EFFECT_NAME in cloth.effects:
        raise InvalidInput(
            "effects of the cloth", got=repr(CORRECTION_EFFECT_NAME), expected="another name: the estimate needs it"
        )
    pushable = copy.deepcopy(cloth)
    pushable.effects[CORRECTION_EFFECT_NAME] = BodyForce(torch.zeros_like(pushable.rest_state().x))
    return pushable


class CorrectedObjective(Objective):
    """One episode, simulated as one continuous motion under a body force that is constant within each window.

    The vector of unknowns holds the fabric's, the nuisances', then the force's, by window, mode and axis. Position,
    velocity and the effects' memory go from window to window as the simulation leaves them.

    Args:
        cloth: of ``add_correction_effect``.
        unknowns: the fabric's.
        episode: with the data.
        force: where and when the cloth may be pushed.
        dt: largest substep [s]; None: the stable one.
        nuisances: of the episode.
        blocks: kinds of data in use.
        noise_floors: least standard deviation by block name.

    Attributes:
        force_slice: where the force stands in the vector of unknowns.
    """

    def __init__(
        self,
        cloth: Cloth,
        unknowns: Sequence[Unknown],
        episode: Episode,
        force: CorrectiveForce,
        dt: float | None = None,
        nuisances: Sequence[AbstractNuisance] = (),
        blocks: Sequence[Block] = (),
        noise_floors: Mapping[str, float] | None = None,
    ) -> None:
        super().__init__(cloth, unknowns, [episode], dt, nuisances, blocks, noise_floors)
        self.force = force
        self.force_slice = slice(len(self.start), len(self.start) + force.count)
        zeros = torch.zeros(force.count, dtype=torch.float64)
        self.start, self.prior_mean = torch.cat([self.start, zeros]), torch.cat([self.prior_mean, zeros])
        self.prior_std = torch.cat([self.prior_std, force.number_stds.double()])
        self._last_tangents: tuple[Tensor, Frames, Frames] | None = None

    def _with_episodes(self, episodes: Sequence[Episode], nuisances: Sequence[AbstractNuisance]) -> CorrectedObjective:
        return CorrectedObjective(
            self.cloth,
            self.unknowns,
            episodes[0],
            self.force,
            self.dt,
            nuisances,
            self.blocks,
            self.noise_floors,
        )

    @property
    def used_data(self) -> Episode:
        """The episode with only the data that the estimate uses."""
        names, episode = [block.name for block in self.blocks], self.episodes[0]
        return replace(
            episode,
            clouds=episode.clouds if "points" in names else [cloud[:0] for cloud in episode.clouds],
            markers=episode.markers if "markers" in names else None,
            wrenches=episode.wrenches if "force" in names else {},
        )

    def rms_distance(self, raw: Tensor) -> float:
        """Compute the rms distance [m] from the points that were used; NaN without points."""
        return distance_metrics(self.simulate_vertices(raw), [self.used_data], self.faces).rms

    def set_force_prior(self, std: Tensor) -> None:
        """Set the standard deviations [M] m/s^2 of the force's prior."""
        self.force = self.force._replace(mode_std=std)
        self.prior_std = self.prior_std.clone()
        self.prior_std[self.force_slice] = self.force.number_stds.to(self.prior_std)

    def problem(self) -> levenberg_marquardt.Problem:
        """Return the callbacks of the solver; the force may move farther in a step than its prior is wide."""
        problem = super().problem()
        max_step = problem.max_step.clone()
        max_step[self.force_slice] = torch.inf
        return problem._replace(max_step=max_step, reported=None)  # a pose is all of them

    def _windows(self, episode: Episode) -> Iterator[tuple[int, Tensor]]:
        """(first frame, frame times) of the windows that the episode has frames of."""
        for first, last in self.force.windows:
            if first < len(episode.times) - 1:
                yield first, episode.times[first : last + 1]

    def simulate_windows(self, raw: Tensor, frames: int | None = None) -> Iterator[Rollout]:
        """Simulate window after window; differentiable when ``raw`` [K] requires grad.

        Args:
            raw: [K] unknowns.
            frames: number of frames; None: all.
        """
        episode = self._initial_episode(raw, 0)
        episode = replace(episode, times=episode.times[:frames])
        fabric = make_state_entries(self.unknowns, raw[: len(self.unknowns)].to(episode.initial))
        fields = self.force.acceleration_field(raw[self.force_slice].to(episode.initial))
        state = first_state(self.cloth, episode)
        for w, (_, times) in enumerate(self._windows(episode)):
            values = {**fabric, CORRECTION_STATE_KEY: fields[w]}
            entries = {f"cloth.{key}": value for key, value in values.items()}
            settles = episode.needs_settling and w == 0
            out = call_with_parameters(_Window(self.cloth), entries, (state, episode, times, self.dt, settles))
            state = out.state
            yield out

    def _simulate_cloth(self, raw: Tensor, i: int) -> Frames:
        """Simulate the episode as an observer without errors sees it."""
        return concatenate_windows([frames_from_rollout(out) for out in self.simulate_windows(raw)])

    def last_state(self, raw: Tensor) -> ClothState:
        """Simulate up to the last observed frame and return the state there."""
        *_, last = self.simulate_windows(raw, self.episodes[0].observed_count)
        return last.state

    def simulate_with_tangents(self, raw: Tensor) -> tuple[Frames, Frames]:
        """Simulate the episode as it is observed, with derivatives by all unknowns; the last answer is remembered."""
        return self._observe_with_derivatives(raw, 0, *self._differentiate(raw, 0))

    def _differentiate(self, raw: Tensor, i: int, by_fabric: bool = True) -> tuple[Frames, Frames]:
        if self._last_tangents is None or not torch.equal(self._last_tangents[0], raw):
            self._last_tangents = raw.clone(), *self._simulate_with_tangents(raw, i)
        return self._last_tangents[1], self._last_tangents[2]

    def _simulate_with_tangents(self, raw: Tensor, i: int) -> tuple[Frames, Frames]:
        """The episode and its derivatives by all unknowns; a later force does not move an earlier window."""
        (mode_columns, modes), episode = self._first_state_modes(i), self._initial_episode(raw, i)
        count, per_window = len(self.unknowns), self.force.count_per_window
        columns = [*range(count), *mode_columns]
        fabric = make_state_entries(self.unknowns, raw[:count].to(episode.initial))
        fields = self.force.acceleration_field(raw[self.force_slice].to(episode.initial))
        basis = torch.einsum("mv,ab->mavb", self.force.modes, torch.eye(3)).flatten(0, 1).to(episode.initial)
        state = first_state(self.cloth, episode)
        state_tangents = initial_state_tangents(self.cloth, episode, modes, count)
        parts, derivative_parts = [], []
        for w, (_, times) in enumerate(self._windows(episode)):
            # the window's force adds directions, along which its first state does not change
            first = self.force_slice.start + w * per_window
            columns += range(first, first + per_window)
            state_tangents = state_tangents.map(lambda t: torch.cat([t, t.new_zeros(per_window, *t.shape[1:])]))
            fabric_directions = torch.eye(len(columns), count, dtype=basis.dtype)
            force_directions = basis.new_zeros(len(columns), *basis.shape[1:])
            force_directions[-per_window:] = basis
            values = {**make_state_entries(self.unknowns, fabric_directions), CORRECTION_STATE_KEY: force_directions}
            along = Directions(values, state_tangents)

            entries = {f"cloth.{key}": v for key, v in {**fabric, CORRECTION_STATE_KEY: fields[w]}.items()}
            settles = episode.needs_settling and w == 0
            arguments = (state, episode, times, self.dt, settles, along)
            out, tangents = call_with_parameters(_Window(self.cloth), entries, arguments)
            state, state_tangents = out.state, tangents.state
            if not bool(state_tangents.x.isfinite().all()):
                raise SimulationDiverged(
                    "pose: what a small push does grows beyond all numbers",
                    got=f"after {float(times[-1]):.2f} s",
                    remedy="the motion is unstable: fewer frames, or float64",
                )
            parts.append(frames_from_rollout(out))
            derivative_parts.append(_spread_columns(frames_from_rollout(tangents), columns, len(raw)))
        return concatenate_windows(parts), concatenate_windows(derivative_parts)


def _spread_columns(derivatives: Frames, columns: Sequence[int], count: int) -> Frames:
    """Derivatives by ``count`` unknowns, zero but for some columns."""
    index = torch.tensor(columns)
    return map_frames(derivatives, lambda d: d.new_zeros(count, *d.shape[1:]).index_copy(0, index, d))


class _Window(nn.Module):
    """A cloth on its way through some frames of an episode."""

    def __init__(self, cloth: Cloth) -> None:
        super().__init__()
        self.cloth = cloth

    def forward(
        self,
        state: ClothState,
        episode: Episode,
        times: Tensor,
        dt: float | None,
        settles: bool,
        along: Directions | None = None,
    ) -> Rollout | tuple[Rollout, Rollout]:
        if along is not None:
            settle = SETTLE_TIME_S if settles else 0.0
            return self.cloth.sensitivities(state, episode.motion, times, along=along, dt=dt, settle=settle)
        if settles:
            state = self.cloth.settle(state, episode.motion, start=float(times[0]), duration=SETTLE_TIME_S)
        return self.cloth(state, episode.motion, times, dt=dt)


def concatenate_windows(parts: Sequence[Frames]) -> Frames:
    """Concatenate windows, each of which begins with the last frame of the one before."""
    names = parts[0].wrench

    def concatenate(tensors: Sequence[Tensor], axis: int) -> Tensor:
        return torch.cat([tensors[0], *(t.narrow(axis, 1, t.shape[axis] - 1) for t in tensors[1:])], dim=axis)

    return Frames(
        concatenate([p.x for p in parts], -3),
        concatenate([p.v for p in parts], -3),
        {name: concatenate([p.wrench[name] for p in parts], -2) for name in names},
        concatenate([p.rim_offset for p in parts], -1),
    )
