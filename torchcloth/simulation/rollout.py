"""Substeps between two frames: checkpointed, and retraced when they go wrong."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial, reduce
from itertools import pairwise
from math import ceil
from typing import NamedTuple

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint as recompute

from .._utils.torch_modes import transformed
from ..boundaries import Drive, drive
from ..dynamics import substep
from ..dynamics.contact.self_contact import CHUNK
from ..dynamics.forces import Impulses, added
from ..dynamics.model import as_it_is
from ..engine.cuda_graphs import Graphs, unit_of
from ..engine.dispatch import Choice
from ..engine.fused import Fused, recomputes
from ..errors import SimulationDiverged
from ..types import ClothState, Rollout, Trajectory
from .argument_checks import check_extent, check_substeps

AT_ONCE = 4_000_000  # vertices times substeps of one call, which nobody can interrupt
FEW = 250  # vertices, as which fewer count
SIDE_BY_SIDE = 128  # scenes on a device
PIECE = 64  # substeps after which one looks at what has set


def divided(frames: Sequence[float], counts: Sequence[int]) -> tuple[list[float], list[int], tuple[int, ...]]:
    """(more frames, so that few substeps lie between two, counts between them, which of them were given)."""
    times, pieces, given = [frames[0]], [], [0]
    for (start, end), count in zip(pairwise(frames), counts, strict=True):
        ends = [count * (k + 1) // ceil(count / PIECE) for k in range(ceil(count / PIECE))]
        pieces += [last - first for first, last in pairwise([0, *ends])]
        times += [*(start + (end - start) * last / count for last in ends[:-1]), end]
        given.append(len(times) - 1)
    return times, pieces, tuple(given)


class Interval(NamedTuple):
    """The time between two frames, in ``count`` equal substeps.

    ``fused``: the engine that runs them, or None. ``moves``: ``motion`` on the substeps, where it is there already.
    ``graphs``: of the reference's substeps, where they are captured.
    """

    model: substep.Model
    motion: Mapping[str, Trajectory]
    start: float  # s
    end: float  # s
    count: int
    fused: Fused | None = None
    moves: Mapping[str, Drive] | None = None
    graphs: Graphs | None = None

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

    model: substep.Model
    motion: Mapping[str, Trajectory]
    frames: list[float]  # s
    counts: list[int]  # substeps between them
    state: ClothState  # at the first frame, with all batch dimensions
    choice: Choice
    longest: float  # m, extent that the contact grid has room for
    step_for: Callable[[ClothState], float] | None = None  # [s], longest from a state on; None: it does not matter
    asked: tuple[int, ...] | None = None  # frames that were asked for; None: all
    graphs: Graphs | None = None  # of the reference's substeps; None: they are launched one by one

    def intervals(self, now: Callable[[], ClothState]) -> Iterator[Interval]:
        """One after the other; ``now``: the state at the start of the next."""
        whole, first = self.drives(), 0
        for interval in self._bare():
            last = first + interval.count
            fewest, span = 0, interval.end - interval.start
            if self.step_for is not None:
                longest = self.step_for(now())
                check_substeps(span, longest)
                fewest = ceil(span / longest - 1e-9)
            if fewest > interval.count:
                yield interval._replace(count=fewest)
            else:
                yield interval._replace(moves=_parts(whole, first, last))
            first = last

    def stretches(self) -> Iterator[tuple[list[Interval], dict[str, Drive]]]:
        """Intervals that one call of the engine may take together, with the drives of all of them."""
        whole, first, last, some = self.drives(), 0, 0, []
        vertices = self.state.x.numel() // 3
        if self.choice.fused is not None and self.choice.fused.is_elsewhere:
            vertices //= SIDE_BY_SIDE
        most = AT_ONCE // max(vertices, FEW)
        for interval in (*self._bare(), None):
            if some and (interval is None or last - first + interval.count > most):
                yield some, _parts(whole, first, last)
                first, some = last, []
            if interval is not None:
                last, some = last + interval.count, [*some, interval]

    @property
    def times(self) -> list[float]:
        """[T] s, of the frames that were asked for."""
        return self.frames if self.asked is None else [self.frames[k] for k in self.asked]

    def results(
        self, states: Sequence[ClothState], impulses: Sequence[Impulses]
    ) -> tuple[Sequence[ClothState], Sequence[Impulses]]:
        """States at the frames that were asked for, and impulses between them."""
        if self.asked is None:
            return states, impulses
        between = [reduce(added, impulses[first:last], {}) for first, last in pairwise(self.asked)]
        return [states[k] for k in self.asked], between

    def drives(self) -> dict[str, Drive]:
        """The motion, resolved for all intervals at once, which costs what one of them does."""
        found = self._bare()
        return _drives(self.motion, torch.cat([*(i.times()[:-1] for i in found), found[-1].times()[-1:]]))

    def _bare(self) -> list[Interval]:
        """Without drives."""
        return [
            Interval(self.model, self.motion, start, end, count, self.choice.fused, None, self.graphs)
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
    fused, state, states, impulses, lost = plan.choice.fused, plan.state, [plan.state], [], None
    # a contact grid and what sets must be looked after between frames
    free = plan.longest == float("inf") and plan.step_for is None
    if fused is not None and free and fused.is_plain(state, plan.motion):
        for some, drives in plan.stretches():
            found = _together(fused, some, states[-1], lost, drives)
            states += [state for state, _, _ in found]
            impulses += [given for _, _, given in found]
            lost = found[-1][1]
        return collect(plan, states, impulses)
    for interval in plan.intervals(lambda: states[-1]):
        state, lost, given = advance(interval, state, lost, checkpoint)
        plan.check(state)
        states.append(state)
        impulses.append(given)
    return collect(plan, states, impulses)


def _together(
    fused: Fused, some: Sequence[Interval], state: ClothState, lost: Tensor | None, drives: Mapping[str, Drive]
) -> list[tuple[ClothState, Tensor | None, Impulses]]:
    """Simulate intervals in one call: what ``advance`` gives of each.

    Raises:
        SimulationDiverged: as there.
    """
    counts = torch.tensor([i.count for i in some])
    steps = torch.tensor([i.dt for i in some], dtype=torch.float64).repeat_interleave(counts)
    found = fused.frames(state, lost, steps, drives, tuple(counts.cumsum(0).tolist()))
    after = [s for s, *_ in found]
    if not bool(torch.isfinite(torch.stack([s.x for s in after])).all()):
        first = 0
        for interval, before, own in zip(some, [state, *after], after, strict=False):
            last = first + interval.count
            check_finite(interval._replace(moves=_parts(drives, first, last)), before, own)
            first = last
    return found


def collect(plan: Plan, states: Sequence[ClothState], impulses: Sequence[Impulses]) -> Rollout:
    """States at the frames and impulses between them, as a rollout."""
    states, impulses = plan.results(states, impulses)
    x, v = (torch.stack(part, dim=-3) for part in ([s.x for s in states], [s.v for s in states]))
    zero, wrench = x.new_zeros(*x.shape[:-3], 6), {}
    durations = [end - start for start, end in pairwise(plan.times)]
    for name in (name for name, boundary in plan.model.boundaries.items() if boundary.driven):
        found = [-j[name] / d if name in j else zero for j, d in zip(impulses, durations, strict=True)]
        wrench[name] = torch.stack([zero, *(f.expand_as(zero) for f in found)], dim=-2)
    return Rollout(torch.tensor(plan.times, dtype=torch.float64), x, v, wrench, states[-1])


def advance(
    interval: Interval, state: ClothState, lost: Tensor | None, checkpoint: bool
) -> tuple[ClothState, Tensor | None, Impulses]:
    """Simulate one interval; impulses are summed over it. ``lost``: see ``functional.stretch``.

    Raises:
        SimulationDiverged: positions are not finite at its end.
    """
    before, drives = state, interval.drives()
    if interval.fused is None:
        state, lost, total = _by_reference(interval, state, lost, drives, checkpoint)
    else:
        run = partial(interval.fused.stretch, checkpoint=checkpoint)
        state, lost, total = run(state, lost, interval.dt, drives, interval.count)
    check_finite(interval, before, state)
    return state, lost, total


def _by_reference(
    interval: Interval, state: ClothState, lost: Tensor | None, drives: Mapping[str, Drive], checkpoint: bool
) -> tuple[ClothState, Tensor | None, Impulses]:
    total: Impulses = {}
    store = checkpoint and recomputes()
    model = interval.model
    if store:
        model = as_it_is(model)
    graphs = None if transformed() else interval.graphs
    chunk = unit_of(interval.count) if graphs is not None and graphs.able else CHUNK
    for first in range(0, interval.count, chunk):
        of = {"dt": interval.dt, "drives": drives, "substeps": min(chunk, interval.count - first), "first": first}
        found = None if graphs is None else graphs.stretch(state, lost, **of)
        if found is None:
            run = partial(substep.stretch, model, **of)
            found = recompute(run, state, lost, use_reentrant=False) if store else run(state, lost)
        state, lost, impulses = found
        total = added(total, impulses)
    return state, lost, total


def check_finite(interval: Interval, before: ClothState, after: ClothState) -> None:
    """Go through an interval again, substep by substep, to name the first vertex that was lost.

    Raises:
        SimulationDiverged: positions are not finite at its end.
    """
    if not bool(torch.isfinite(after.x.detach()).all()):
        raise _divergence(interval, before, after)


@torch.no_grad()
def _divergence(interval: Interval, state: ClothState, after: ClothState) -> SimulationDiverged:
    drives, k, low = interval.drives(), 0, None
    run = partial(substep.stretch, interval.model) if interval.fused is None else interval.fused.stretch
    for k in range(interval.count):
        state, low, _ = run(state, low, interval.dt, _parts(drives, k, k + 1), 1)
        if not bool(torch.isfinite(state.x).all()):
            break
    else:  # searched at every substep, layers may have passed each other otherwise
        state = after
    gone = ~torch.isfinite(state.x).all(-1)
    vertex = int(gone.reshape(-1, gone.shape[-1]).any(0).nonzero()[0])
    return SimulationDiverged(
        f"simulation diverged at t = {float(interval.times()[k + 1]):.6g} s",
        got=f"vertex {vertex} not finite after substep {k + 1} of {interval.count}",
        expected="finite positions",
        remedy="check the initial positions and the motion for jumps and units (m), or lower dt",
    )
