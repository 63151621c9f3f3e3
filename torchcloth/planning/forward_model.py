"""The cloth under a motion, as one model has it, from the episode's first shape to the end of the wait."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from ..cloth import Cloth
from ..diagnosis.data.dataset import LATE
from ..episodes.observed import RATE, Episode, episode
from ..episodes.replay import SETTLING, Frames, frames_of
from ..episodes.world import Model, World
from ..recordings import Recording
from ..simulation.sensitivities import Directions
from ..types import ClothState, Trajectory
from .episode_conversion import held_until
from .motion_parameters import Course

NUDGE = 1e-3  # of a direction, by which what an observer has is differentiated


class Rehearsal:
    """One model, ready to be run under any motion of the courses.

    Args:
        model: the cloth, what robots do other than they say, and how it is seen.
        recording: where the cloth is at first.
        courses: of the grippers that are planned for; all others move as recorded.
        dt: s, largest substep.
    """

    def __init__(self, model: Model, recording: Recording, courses: Sequence[Course], dt: float | None) -> None:
        self.world, self.dt = model.world(), dt
        self.world.cloth.requires_grad_(False)
        self.mesh = model.base.cloth.mesh  # on which an observer has it, whatever patches a grip really holds
        self.faces = torch.as_tensor(self.mesh.faces)
        seen = episode(model.base.cloth, recording, RATE)  # which a world may carry over to a mesh of its own
        span, last = courses[0].span, float(courses[0].t[-1])
        count = max(1, round((last - span.begin) * RATE))
        self.times = torch.linspace(span.begin, last, count + 1, dtype=torch.float64)
        late = [last + LATE] if self.world.views else []  # what a late clock sees
        times = torch.cat([self.times, self.times.new_tensor(late)])
        nothing = [seen.initial.new_zeros(0, 3)] * len(times)
        others = {name: held_until(path, float(times[-1])) for name, path in seen.motion.items()}
        self.blank: Episode = replace(
            seen, motion=others, times=times, clouds=nothing, markers=None, places=None, wrenches={}, unseen=0
        )
        with torch.no_grad():
            self._first = self._moved({c.name: c.trajectory(c.nothing) for c in courses})
            driven = self.world.driven(self._first)
            state = self.world.cloth.state(driven.initial)
            if driven.settles:  # nothing is added to where grippers are at first, so it is the same under all motions
                state = self.world.cloth.settle(state, driven.motion, start=span.begin, duration=SETTLING)
            self.state = state

    def run(self, motion: Mapping[str, Trajectory]) -> Tensor:
        """[T, V, 3] m, what an observer has of the cloth under these motions; differentiable in their poses."""
        driven = self._driven(motion)
        rollout = self.world.cloth(self.state, driven.motion, self.blank.times, dt=self.dt)
        return self._seen(frames_of(rollout), driven)

    def go_on(self, state: ClothState, motion: Mapping[str, Trajectory], begin: float, end: float) -> ClothState:
        """The cloth itself at ``end`` [s] under these motions, from what it is at ``begin``."""
        return self.world.cloth(state, self._driven(motion).motion, [begin, end], dt=self.dt, checkpoint=False).state

    def last(self, motion: Mapping[str, Trajectory], moved: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        """([V, 3] m at the end, its derivatives [N, V, 3] where poses change by ``moved`` [N, K, 4, 4])."""
        driven, along = self._driven(motion), self._tangents(motion, moved)
        out, way = self.world.cloth.sensitivities(
            self.state, driven.motion, self.blank.times, along=Directions(motion=along), dt=self.dt
        )
        plain, moves = frames_of(out), frames_of(way)
        x = self._seen(plain, driven)[-1]
        if not self.world.views:
            return x, moves.x[:, -1]
        beside = [self._seen(_nudged(plain, moves, k), driven)[-1] for k in range(len(moves.x))]
        return x, (torch.stack(beside) - x) / NUDGE

    def identity(self) -> list[object]:
        """What runs depend on beside the cloth and the motion."""
        return [*self.world.identity(self._first), *self.state[:3], self.dt]

    def _driven(self, motion: Mapping[str, Trajectory]) -> Episode:
        return self.world.driven(self._moved(motion))

    def _moved(self, motion: Mapping[str, Trajectory]) -> Episode:
        still = {name: held_until(m, float(self.blank.times[-1])) for name, m in motion.items()}
        as_cloth = {name: m._replace(pose=m.pose.to(self.blank.initial)) for name, m in still.items()}
        return replace(self.blank, motion={**self.blank.motion, **as_cloth})

    def _tangents(self, motion: Mapping[str, Trajectory], moved: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Of what robots really do: their errors are not known as formulas, so by small steps where they have any."""
        plain, count = self._driven(motion).motion, len(next(iter(moved.values())))
        if not self.world.motions:
            longer = lambda name: len(plain[name].t) - moved[name].shape[1]  # noqa: E731 - where it stands still
            held = {name: [own, own[:, -1:].expand(-1, longer(name), 4, 4)] for name, own in moved.items()}
            return {name: torch.cat(parts, 1).to(self.state.x) for name, parts in held.items()}
        steps = []
        for k in range(count):
            nudged = {name: m._replace(pose=m.pose + NUDGE * moved[name][k]) for name, m in motion.items()}
            steps.append(self._driven(nudged).motion)
        return {name: torch.stack([(s[name].pose - plain[name].pose) / NUDGE for s in steps]) for name in moved}

    def _seen(self, frames: Frames, driven: Episode) -> Tensor:
        return self.world.seen(frames, driven).x[: len(self.times)]


def plain(cloth: Cloth) -> Model:
    """A cloth as a model whose robot and observer do as they say; it stays the user's."""
    return Model(World(cloth), (), torch.zeros(0))


def _nudged(plain: Frames, moves: Frames, k: int) -> Frames:
    return plain._replace(x=plain.x + NUDGE * moves.x[k], v=plain.v + NUDGE * moves.v[k])
