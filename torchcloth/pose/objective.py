"""A simulation that is pushed a little, window by window, so that it stays with what was seen."""

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
from ..episodes.replay import SETTLING, Frames, each, frames_of, state_along
from ..episodes.unknowns import Unknown, overrides
from ..errors import InvalidInput, SimulationDiverged
from ..identification.estimators import levenberg_marquardt
from ..identification.estimators.objective import Objective, pushed
from ..identification.nuisances import AbstractNuisance
from ..identification.residuals.blocks import Block
from ..identification.residuals.metrics import figures
from ..parameters import called
from ..simulation.sensitivities import Directions
from ..types import ClothState, Rollout

CORRECTION = "correction"  # the effect's name in the model
KEY = f"effects.{CORRECTION}.acceleration.raw"


class Correction(NamedTuple):
    """Where and when the cloth may be pushed."""

    windows: list[tuple[int, int]]  # first and last frame of each; the last is the first of the next
    modes: Tensor  # [M, V]
    std: Tensor  # [M] m/s^2, of the prior of every number

    @property
    def count(self) -> int:
        """Of its numbers: windows, modes, axes."""
        return len(self.windows) * self.each

    @property
    def each(self) -> int:
        """Of the numbers of one window."""
        return 3 * len(self.modes)

    @property
    def stds(self) -> Tensor:
        """[count] m/s^2."""
        return self.std.repeat_interleave(3).repeat(len(self.windows))

    def field(self, numbers: Tensor) -> Tensor:
        """[W, V, 3] m/s^2 from numbers [count]."""
        return torch.einsum("wmc,mv->wvc", numbers.unflatten(0, (len(self.windows), -1, 3)), self.modes.to(numbers))


def windows_of(times: Tensor, length: float) -> list[tuple[int, int]]:
    """Windows of about ``length`` [s] that cover all frames, at least one frame interval each."""
    span = float(times[-1] - times[0])
    if length < 0.5 * float(times.diff().min()):  # one for each interval; not as many as so small a length asks for
        return list(pairwise(range(len(times))))
    wanted = torch.linspace(0.0, span, max(1, round(span / length)) + 1, dtype=times.dtype).to(times)
    ends = (times[None] - times[0] - wanted[:, None]).abs().argmin(1).unique().tolist()
    return list(pairwise(ends))


def pushable(cloth: Cloth) -> Cloth:
    """A copy of a cloth with one effect more, a body force of zero.

    Raises:
        InvalidInput: it has an effect of this name already.
    """
    if CORRECTION in cloth.effects:
        raise InvalidInput("effects of the cloth", got=repr(CORRECTION), expected="another name: the estimate needs it")
    own = copy.deepcopy(cloth)
    own.effects[CORRECTION] = BodyForce(torch.zeros_like(own.rest_state().x))
    return own


class Corrected(Objective):
    """One episode, simulated as one continuous motion under a body force that is constant within each window.

    The vector of unknowns holds the fabric's, the nuisances', then the force's: window, mode, axis. Position, velocity
    and all that the cloth remembers go from window to window as the simulation leaves them.
    """

    def __init__(
        self,
        cloth: Cloth,
        unknowns: Sequence[Unknown],
        episode: Episode,
        correction: Correction,
        dt: float | None = None,
        nuisances: Sequence[AbstractNuisance] = (),
        blocks: Sequence[Block] = (),
        floors: Mapping[str, float] | None = None,
    ) -> None:
        super().__init__(cloth, unknowns, [episode], dt, nuisances, blocks, floors)
        self.correction = correction
        self.pushes = slice(len(self.start), len(self.start) + correction.count)
        nothing = torch.zeros(correction.count, dtype=torch.float64)
        self.start, self.middle = torch.cat([self.start, nothing]), torch.cat([self.middle, nothing])
        self.prior_std = torch.cat([self.prior_std, correction.stds.double()])
        self._known: tuple[Tensor, Frames, Frames] | None = None

    def _like(self, episodes: Sequence[Episode], nuisances: Sequence[AbstractNuisance]) -> Corrected:
        own = self.cloth, self.unknowns, episodes[0], self.correction
        return Corrected(*own, self.dt, nuisances, self.blocks, self.floors)

    @property
    def used(self) -> Episode:
        """The episode with what the estimate has seen: all else tells of its distances only."""
        blocks, own = [block.name for block in self.blocks], self.episodes[0]
        return replace(
            own,
            clouds=own.clouds if "points" in blocks else [cloud[:0] for cloud in own.clouds],
            markers=own.markers if "markers" in blocks else None,
            wrenches=own.wrenches if "force" in blocks else {},
        )

    def missed(self, raw: Tensor) -> float:
        """m, rms distance of what was used; NaN where nothing of it was seen."""
        return figures(self.frames(raw), [self.used], self.faces).rms

    def expecting(self, std: Tensor) -> None:
        """Take other standard deviations [M] m/s^2 of the force as its prior."""
        self.correction = self.correction._replace(std=std)
        self.prior_std = self.prior_std.clone()
        self.prior_std[self.pushes] = self.correction.stds.to(self.prior_std)

    def problem(self) -> levenberg_marquardt.Problem:
        """The callbacks of Gauss-Newton; the force may move farther in a step than its prior is wide."""
        problem = super().problem()
        longest = problem.longest.clone()
        longest[self.pushes] = torch.inf
        return problem._replace(longest=longest)

    def _windows(self, episode: Episode) -> Iterator[tuple[int, Tensor]]:
        """(first frame, frame times) of the windows that the episode has frames of."""
        for first, last in self.correction.windows:
            if first < len(episode.times) - 1:
                yield first, episode.times[first : last + 1]

    def rollouts(self, raw: Tensor, frames: int | None = None) -> Iterator[Rollout]:
        """Window after window, of all frames or the first; differentiable when ``raw`` requires grad."""
        episode = self._begun(raw, 0)
        episode = replace(episode, times=episode.times[:frames])
        entries = overrides(self.unknowns, raw[: len(self.unknowns)].to(episode.initial))
        fields = self.correction.field(raw[self.pushes].to(episode.initial))
        state = self.cloth.state(episode.initial)
        for w, (_, times) in enumerate(self._windows(episode)):
            own = {f"cloth.{key}": value for key, value in {**entries, KEY: fields[w]}.items()}
            settles = episode.settles and w == 0
            out = called(_Window(self.cloth), own, (state, episode, times, self.dt, settles))
            state = out.state
            yield out

    def simulate(self, raw: Tensor, i: int) -> Frames:
        """The episode as it is seen."""
        frames = joined([frames_of(out) for out in self.rollouts(raw)])
        for p in self.placed[i]:
            frames = p.nuisance.see(frames, raw[p.where].to(frames.x), self.episodes[i])
        return frames

    def last_state(self, raw: Tensor) -> ClothState:
        """At the last observed frame."""
        *_, last = self.rollouts(raw, self.episodes[0].observed)
        return last.state

    def tangents(self, raw: Tensor) -> tuple[Frames, Frames]:
        """The episode as it is seen, and its derivatives by all unknowns; the last answer is remembered."""
        return self._tangents(raw, 0)

    def _tangents(self, raw: Tensor, i: int) -> tuple[Frames, Frames]:
        if self._known is None or not torch.equal(self._known[0], raw):
            frames, moved = self._pushed_tangents(raw, i)
            for p in self.placed[i]:
                frames, moved = pushed(p, frames, moved, raw, self.episodes[i])
            self._known = raw.clone(), frames, moved
        return self._known[1], self._known[2]

    def _pushed_tangents(self, raw: Tensor, i: int) -> tuple[Frames, Frames]:
        """The episode and its derivatives by all unknowns; no window is moved by a later one's force."""
        own, episode = self._modes(i), self._begun(raw, i)
        modes = torch.cat([m for _, m in own]) if own else episode.initial.new_zeros(0, *episode.initial.shape)
        count = len(self.unknowns)
        index = [*range(count), *(k for where, _ in own for k in range(where.start, where.stop))]
        fabric = overrides(self.unknowns, raw[:count].to(episode.initial))
        fields = self.correction.field(raw[self.pushes].to(episode.initial))
        basis = torch.einsum("mv,ab->mavb", self.correction.modes, torch.eye(3)).flatten(0, 1).to(episode.initial)
        state, moved = self.cloth.state(episode.initial), state_along(self.cloth, episode, modes, count)
        parts, ways = [], []
        for w, (_, times) in enumerate(self._windows(episode)):
            first = self.pushes.start + w * self.correction.each
            index += range(first, first + self.correction.each)
            moved = moved.map(lambda t: torch.cat([t, t.new_zeros(self.correction.each, *t.shape[1:])]))
            eye = torch.eye(len(index), count, dtype=basis.dtype)
            push = basis.new_zeros(len(index), *basis.shape[1:])
            push[-self.correction.each :] = basis
            along = Directions({**overrides(self.unknowns, eye), KEY: push}, moved)
            entries = {f"cloth.{key}": value for key, value in {**fabric, KEY: fields[w]}.items()}
            settles = episode.settles and w == 0
            call = (state, episode, times, self.dt, settles, along)
            out, way = called(_Window(self.cloth), entries, call)
            state, moved = out.state, way.state
            if not bool(moved.x.isfinite().all()):
                raise SimulationDiverged(
                    "pose: what a small push does grows beyond all numbers",
                    got=f"after {float(times[-1]):.2f} s",
                    remedy="the motion is unstable: fewer frames, or float64",
                )
            parts.append(frames_of(out))
            spread = torch.tensor(index)
            full = lambda d, at=spread: d.new_zeros(len(raw), *d.shape[1:]).index_copy(0, at, d)  # noqa: E731
            ways.append(each(frames_of(way), full))
        return joined(parts), joined(ways)


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
        """The rollout, and its derivatives along some directions."""
        if along is not None:
            settle = SETTLING if settles else 0.0
            return self.cloth.sensitivities(state, episode.motion, times, along=along, dt=dt, settle=settle)
        if settles:
            state = self.cloth.settle(state, episode.motion, start=float(times[0]), duration=SETTLING)
        return self.cloth(state, episode.motion, times, dt=dt)


def joined(parts: Sequence[Frames]) -> Frames:
    """Windows one after the other; each begins with the frame that the one before ended with."""
    names = parts[0].wrench

    def along(tensors: Sequence[Tensor], axis: int) -> Tensor:
        return torch.cat([tensors[0], *(t.narrow(axis, 1, t.shape[axis] - 1) for t in tensors[1:])], dim=axis)

    return Frames(
        along([p.x for p in parts], -3),
        along([p.v for p in parts], -3),
        {name: along([p.wrench[name] for p in parts], -2) for name in names},
        along([p.edge for p in parts], -1),
    )
