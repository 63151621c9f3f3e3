"""Substeps between two frames: checkpointed, and retraced when they go wrong."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint as recompute

from . import functional
from .boundaries import Drive, drive
from .dynamics import Impulses, added
from .engine.choice import Choice
from .engine.fused import Fused, recomputes
from .errors import SimulationDiverged
from .model import as_it_is
from .self_contact import CHUNK
from .types import ClothState, Rollout, Trajectory
from .validation import check_extent

AT_ONCE = 4_000_000  # vertices times substeps of one call, which nobody can interrupt
FEW = 250  # vertices, as which fewer count


class Interval(NamedTuple):
    """The time between two frames, in ``count`` equal substeps.

    ``fused``: the engine that runs them, or None. ``moves``: ``motion`` on the substeps, where it is there already.
    """

    model: functional.Model
    motion: Mapping[str, Trajectory]
    start: float  # s
    end: float  # s
    count: int
    fused: Fused | None = None
    moves: Mapping[str, Drive] | None = None

    @property
    def dt(self) -> float:
        """Substep [s]."""
        return (self.end - self.start) / self.count

    def times(self) -> Tensor:
        """[count + 1] s."""
        return torch.linspace(self.start, self.end, self.count + 1, dtype=torch.float64)

    def drives(self) -> dict[str, Drive]:
        """The trajectories on the substeps."""
        return dict(_drives(self.motion, self.times()) if self.moves is None else self.moves)


def _drives(motion: Mapping[str, Trajectory], times: Tensor) -> dict[str, Drive]:
    return {name: drive(trajectory, times) for name, trajectory in motion.items()}


def _parts(drives: Mapping[str, Drive], first: int, last: int) -> dict[str, Drive]:
    """Some of the substeps."""
    some = slice(first, last)
    return {
        name: Drive(whole.increment[..., some, :, :], whole.pose[..., some, :, :], whole.closed[some])
        for name, whole in drives.items()
    }


class Plan(NamedTuple):
    """A simulation that has been checked and can begin."""

    model: functional.Model
    motion: Mapping[str, Trajectory]
    frames: list[float]  # s
    counts: list[int]  # substeps between them
    state: ClothState  # at the first frame, with all batch dimensions
    choice: Choice
    longest: float  # m, extent that the contact grid has room for

    def intervals(self) -> Iterator[Interval]:
        """One after the other."""
        whole, first = self.drives(), 0
        for interval in self._bare():
            last = first + interval.count
            yield interval._replace(moves=_parts(whole, first, last))
            first = last

    def stretches(self) -> Iterator[tuple[list[Interval], dict[str, Drive]]]:
        """Intervals that one call of the engine may take together, with the drives of all of them."""
        whole, first, last, some = self.drives(), 0, 0, []
        most = AT_ONCE // max(self.state.x.numel() // 3, FEW)
        for interval in (*self._bare(), None):
            if some and (interval is None or last - first + interval.count > most):
                yield some, _parts(whole, first, last)
                first, some = last, []
            if interval is not None:
                last, some = last + interval.count, [*some, interval]

    def drives(self) -> dict[str, Drive]:
        """The motion, resolved for all intervals at once, which costs what one of them does."""
        found = self._bare()
        return _drives(self.motion, torch.cat([*(i.times()[:-1] for i in found), found[-1].times()[-1:]]))

    def _bare(self) -> list[Interval]:
        """Without drives."""
        return [
            Interval(self.model, self.motion, start, end, count, self.choice.fused)
            for (start, end), count in zip(pairwise(self.frames), self.counts, strict=True)
        ]

    def check(self, state: ClothState) -> None:
        """Refuse a cloth that has been torn apart."""
        if self.longest < float("inf"):
            check_extent(state.x, self.longest)


def run(plan: Plan, checkpoint: bool) -> Rollout:
    """The whole simulation.

    Raises:
        SimulationDiverged: the state lost finiteness.
    """
    fused, state, states, impulses = plan.choice.fused, plan.state, [plan.state], []
    # a contact grid must be looked after between frames
    if fused is not None and plan.longest == float("inf") and fused.is_plain(state, plan.motion):
        for some, drives in plan.stretches():
            for state, given in _together(fused, some, states[-1], drives):
                states.append(state)
                impulses.append(given)
        return collect(plan, states, impulses)
    for interval in plan.intervals():
        state, given = advance(interval, state, checkpoint)
        plan.check(state)
        states.append(state)
        impulses.append(given)
    return collect(plan, states, impulses)


def _together(
    fused: Fused, some: Sequence[Interval], state: ClothState, drives: Mapping[str, Drive]
) -> list[tuple[ClothState, Impulses]]:
    """Simulate intervals in one call: what ``advance`` gives of each.

    Raises:
        SimulationDiverged: as there.
    """
    counts = torch.tensor([i.count for i in some])
    steps = torch.tensor([i.dt for i in some], dtype=torch.float64).repeat_interleave(counts)
    found = fused.frames(state, steps, drives, tuple(counts.cumsum(0).tolist()))
    after = [s for s, _ in found]
    if not bool(torch.isfinite(torch.stack([s.x for s in after])).all()):
        first = 0
        for interval, before, own in zip(some, [state, *after], after, strict=False):
            last = first + interval.count
            check_finite(interval._replace(moves=_parts(drives, first, last)), before, own)
            first = last
    return found


def collect(plan: Plan, states: Sequence[ClothState], impulses: Sequence[Impulses]) -> Rollout:
    """States at the frames and impulses between them, as a rollout."""
    x, v = (torch.stack(part, dim=-3) for part in ([s.x for s in states], [s.v for s in states]))
    zero, wrench = x.new_zeros(*x.shape[:-3], 6), {}
    durations = [end - start for start, end in pairwise(plan.frames)]
    for name in (name for name, boundary in plan.model.boundaries.items() if boundary.driven):
        found = [-j[name] / d if name in j else zero for j, d in zip(impulses, durations, strict=True)]
        wrench[name] = torch.stack([zero, *(f.expand_as(zero) for f in found)], dim=-2)
    return Rollout(torch.tensor(plan.frames, dtype=torch.float64), x, v, wrench, states[-1])


def advance(interval: Interval, state: ClothState, checkpoint: bool) -> tuple[ClothState, Impulses]:
    """Simulate one interval; impulses are summed over it.

    Raises:
        SimulationDiverged: positions are not finite at its end.
    """
    before, drives = state, interval.drives()
    if interval.fused is None:
        state, total = _by_reference(interval, state, drives, checkpoint)
    else:
        state, total = interval.fused.rollout(state, interval.dt, drives, interval.count, checkpoint=checkpoint)
    check_finite(interval, before, state)
    return state, total


def _by_reference(
    interval: Interval, state: ClothState, drives: Mapping[str, Drive], checkpoint: bool
) -> tuple[ClothState, Impulses]:
    total: Impulses = {}
    store = checkpoint and recomputes()
    model = interval.model
    if store:
        model = as_it_is(model)
    for first in range(0, interval.count, CHUNK):
        substeps = min(CHUNK, interval.count - first)
        run = partial(functional.rollout, model, dt=interval.dt, drives=drives, substeps=substeps, first=first)
        state, impulses = recompute(run, state, use_reentrant=False) if store else run(state)
        total = added(total, impulses)
    return state, total


def check_finite(interval: Interval, before: ClothState, after: ClothState) -> None:
    """Go through an interval again, substep by substep, to name the first vertex that was lost.

    Raises:
        SimulationDiverged: positions are not finite at its end.
    """
    if not bool(torch.isfinite(after.x.detach()).all()):
        raise _divergence(interval, before)


@torch.no_grad()
def _divergence(interval: Interval, state: ClothState) -> SimulationDiverged:
    drives, k, vertex = interval.drives(), 0, 0
    run = partial(functional.rollout, interval.model) if interval.fused is None else interval.fused.rollout
    for k in range(interval.count):
        state, _ = run(state, interval.dt, drives, 1, k)
        lost = ~torch.isfinite(state.x).all(-1)
        if bool(lost.any()):
            vertex = int(lost.reshape(-1, lost.shape[-1]).any(0).nonzero()[0])
            break
    return SimulationDiverged(
        f"simulation diverged at t = {float(interval.times()[k + 1]):.6g} s",
        got=f"vertex {vertex} not finite after substep {k + 1} of {interval.count}",
        expected="finite positions",
        remedy="check the initial positions and the motion for jumps, or lower dt",
    )
