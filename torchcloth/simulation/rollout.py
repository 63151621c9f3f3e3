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

from .._utils.torch_modes import under_torch_transform
from ..boundaries import PrescribedMotion, sample_trajectory
from ..dynamics import substep
from ..dynamics.contact.self_contact import SUBSTEPS_PER_CHECKPOINT
from ..dynamics.forces import Impulses, add_impulses
from ..dynamics.model import Model, freeze_parameters
from ..engine.cuda_graphs import Graphs, unit_of
from ..engine.dispatch import Choice
from ..engine.fused import Fused, recomputes
from ..errors import SimulationDiverged
from ..types import ClothState, Rollout, Trajectory
from .argument_checks import check_extent, check_substeps

MAX_VERTEX_SUBSTEPS_PER_CALL = 4_000_000  # vertices times substeps of one call, which nobody can interrupt
MIN_COUNTED_VERTICES = 250  # vertices, as which fewer count
SCENES_PER_DEVICE = 128  # scenes on a device
SUBSTEPS_BETWEEN_STABILITY_CHECKS = 64  # substeps after which one looks at what has set


def subdivide_intervals(frames: Sequence[float], counts: Sequence[int]) -> tuple[list[float], list[int], tuple[int, ...]]:
    """(more frames, so that few substeps lie between two, counts between them, which of them were given)."""
    times, pieces, given = [frames[0]], [], [0]
    for (start, end), count in zip(pairwise(frames), counts, strict=True):
        ends = [count * (k + 1) // ceil(count / SUBSTEPS_BETWEEN_STABILITY_CHECKS) for k in range(ceil(count / SUBSTEPS_BETWEEN_STABILITY_CHECKS))]
        pieces += [last - first for first, last in pairwise([0, *ends])]
        times += [*(start + (end - start) * last / count for last in ends[:-1]), end]
        given.append(len(times) - 1)
    return times, pieces, tuple(given)


class FrameInterval(NamedTuple):
    """The time between two frames, in ``count`` equal substeps.

    ``fused``: the engine that runs them, or None. ``moves``: ``motion`` on the substeps, where it is there already.
    ``graphs``: of the reference's substeps, where they are captured.
    """

    model: Model
    motion: Mapping[str, Trajectory]
    start: float  # s
    end: float  # s
    count: int
    fused: Fused | None = None
    prescribed: Mapping[str, PrescribedMotion] | None = None
    graphs: Graphs | None = None

    @property
    def dt(self) -> float:
        """Substep [s]."""
        return (self.end - self.start) / self.count

    def substep_times(self) -> Tensor:
        """[count + 1] s."""
        return torch.linspace(self.start, self.end, self.count + 1, dtype=torch.float64)

    def sample_motion(self) -> dict[str, PrescribedMotion]:
        """The trajectories on the substeps."""
        return dict(_drives(self.motion, self.substep_times()) if self.prescribed is None else self.prescribed)


def _drives(motion: Mapping[str, Trajectory], times: Tensor) -> dict[str, PrescribedMotion]:
    return {name: sample_trajectory(trajectory, times) for name, trajectory in motion.items()}


def _parts(drives: Mapping[str, PrescribedMotion], first: int, last: int) -> dict[str, PrescribedMotion]:
    """Some of the substeps."""
    some = slice(first, last)
    return {
        name: PrescribedMotion(whole.increment[..., some, :, :], whole.pose[..., some, :, :], whole.closed[some])
        for name, whole in drives.items()
    }


class RolloutSchedule(NamedTuple):
    """A simulation that has been checked and can begin."""

    model: Model
    motion: Mapping[str, Trajectory]
    frames: list[float]  # s
    counts: list[int]  # substeps between them
    state: ClothState  # at the first frame, with all batch dimensions
    choice: Choice
    max_extent: float  # m, extent that the contact grid has room for
    step_for: Callable[[ClothState], float] | None = None  # [s], longest from a state on; None: it does not matter
    requested_frames: tuple[int, ...] | None = None  # frames that were asked for; None: all
    graphs: Graphs | None = None  # of the reference's substeps; None: they are launched one by one

    def iterate_intervals(self, now: Callable[[], ClothState]) -> Iterator[FrameInterval]:
        """One after the other; ``now``: the state at the start of the next."""
        whole, first = self.sample_motion(), 0
        for interval in self._bare_intervals():
            last = first + interval.count
            fewest, span = 0, interval.end - interval.start
            if self.step_for is not None:
                longest = self.step_for(now())
                check_substeps(span, longest)
                fewest = ceil(span / longest - 1e-9)
            if fewest > interval.count:
                yield interval._replace(count=fewest)
            else:
                yield interval._replace(prescribed=_parts(whole, first, last))
            first = last

    def iterate_blocks(self) -> Iterator[tuple[list[FrameInterval], dict[str, PrescribedMotion]]]:
        """Intervals that one call of the engine may take together, with the drives of all of them."""
        whole, first, last, some = self.sample_motion(), 0, 0, []
        vertices = self.state.x.numel() // 3
        if self.choice.fused is not None and self.choice.fused.is_elsewhere:
            vertices //= SCENES_PER_DEVICE
        most = MAX_VERTEX_SUBSTEPS_PER_CALL // max(vertices, MIN_COUNTED_VERTICES)
        for interval in (*self._bare_intervals(), None):
            if some and (interval is None or last - first + interval.count > most):
                yield some, _parts(whole, first, last)
                first, some = last, []
            if interval is not None:
                last, some = last + interval.count, [*some, interval]

    @property
    def times(self) -> list[float]:
        """[T] s, of the frames that were asked for."""
        return self.frames if self.requested_frames is None else [self.frames[k] for k in self.requested_frames]

    def at_requested_frames(
        self, states: Sequence[ClothState], impulses: Sequence[Impulses]
    ) -> tuple[Sequence[ClothState], Sequence[Impulses]]:
        """States at the frames that were asked for, and impulses between them."""
        if self.requested_frames is None:
            return states, impulses
        between = [reduce(add_impulses, impulses[first:last], {}) for first, last in pairwise(self.requested_frames)]
        return [states[k] for k in self.requested_frames], between

    def sample_motion(self) -> dict[str, PrescribedMotion]:
        """The motion, resolved for all intervals at once, which costs what one of them does."""
        found = self._bare_intervals()
        return _drives(self.motion, torch.cat([*(i.substep_times()[:-1] for i in found), found[-1].substep_times()[-1:]]))

    def _bare_intervals(self) -> list[FrameInterval]:
        """Without drives."""
        return [
            FrameInterval(self.model, self.motion, start, end, count, self.choice.fused, None, self.graphs)
            for (start, end), count in zip(pairwise(self.frames), self.counts, strict=True)
        ]

    def check_extent(self, state: ClothState) -> None:
        """Refuse a cloth that has been torn apart."""
        if self.max_extent < float("inf"):
            check_extent(state.x, self.max_extent)


def run_schedule(schedule: RolloutSchedule, checkpoint: bool) -> Rollout:
    """The whole simulation.

    Raises:
        SimulationDiverged: the state lost finiteness.
    """
    fused, state, states, impulses, lost = schedule.choice.fused, schedule.state, [schedule.state], [], None
    # a contact grid and what sets must be looked after between frames
    free = schedule.max_extent == float("inf") and schedule.step_for is None
    if fused is not None and free and fused.is_plain(state, schedule.motion):
        for some, drives in schedule.iterate_blocks():
            found = _run_fused_block(fused, some, states[-1], lost, drives)
            states += [state for state, _, _ in found]
            impulses += [given for _, _, given in found]
            lost = found[-1][1]
        return collect_rollout(schedule, states, impulses)
    for interval in schedule.iterate_intervals(lambda: states[-1]):
        state, lost, given = advance_interval(interval, state, lost, checkpoint)
        schedule.check_extent(state)
        states.append(state)
        impulses.append(given)
    return collect_rollout(schedule, states, impulses)


def _run_fused_block(
    fused: Fused, some: Sequence[FrameInterval], state: ClothState, compensation: Tensor | None, drives: Mapping[str, PrescribedMotion]
) -> list[tuple[ClothState, Tensor | None, Impulses]]:
    """Simulate intervals in one call: what ``advance`` gives of each.

    Raises:
        SimulationDiverged: as there.
    """
    counts = torch.tensor([i.count for i in some])
    steps = torch.tensor([i.dt for i in some], dtype=torch.float64).repeat_interleave(counts)
    found = fused.frames(state, compensation, steps, drives, tuple(counts.cumsum(0).tolist()))
    after = [s for s, *_ in found]
    if not bool(torch.isfinite(torch.stack([s.x for s in after])).all()):
        first = 0
        for interval, before, own in zip(some, [state, *after], after, strict=False):
            last = first + interval.count
            check_finite(interval._replace(prescribed=_parts(drives, first, last)), before, own)
            first = last
    return found


def collect_rollout(schedule: RolloutSchedule, states: Sequence[ClothState], impulses: Sequence[Impulses]) -> Rollout:
    """States at the frames and impulses between them, as a rollout."""
    states, impulses = schedule.at_requested_frames(states, impulses)
    x, v = (torch.stack(part, dim=-3) for part in ([s.x for s in states], [s.v for s in states]))
    zero, wrench = x.new_zeros(*x.shape[:-3], 6), {}
    durations = [end - start for start, end in pairwise(schedule.times)]
    for name in (name for name, boundary in schedule.model.boundaries.items() if boundary.is_prescribed):
        found = [-j[name] / d if name in j else zero for j, d in zip(impulses, durations, strict=True)]
        wrench[name] = torch.stack([zero, *(f.expand_as(zero) for f in found)], dim=-2)
    return Rollout(torch.tensor(schedule.times, dtype=torch.float64), x, v, wrench, states[-1])


def advance_interval(
    interval: FrameInterval, state: ClothState, compensation: Tensor | None, checkpoint: bool
) -> tuple[ClothState, Tensor | None, Impulses]:
    """Simulate one interval; impulses are summed over it. ``lost``: see ``functional.stretch``.

    Raises:
        SimulationDiverged: positions are not finite at its end.
    """
    before, drives = state, interval.sample_motion()
    if interval.fused is None:
        state, compensation, total = _run_reference(interval, state, compensation, drives, checkpoint)
    else:
        run = partial(interval.fused.stretch, checkpoint=checkpoint)
        state, compensation, total = run(state, compensation, interval.dt, drives, interval.count)
    check_finite(interval, before, state)
    return state, compensation, total


def _run_reference(
    interval: FrameInterval, state: ClothState, compensation: Tensor | None, drives: Mapping[str, PrescribedMotion], checkpoint: bool
) -> tuple[ClothState, Tensor | None, Impulses]:
    total: Impulses = {}
    store = checkpoint and recomputes()
    model = interval.model
    if store:
        model = freeze_parameters(model)
    graphs = None if under_torch_transform() else interval.graphs
    chunk = unit_of(interval.count) if graphs is not None and graphs.able else SUBSTEPS_PER_CHECKPOINT
    for first in range(0, interval.count, chunk):
        of = {"dt": interval.dt, "prescribed": drives, "substeps": min(chunk, interval.count - first), "first": first}
        found = None if graphs is None else graphs.rollout_segment(state, compensation, **of)
        if found is None:
            run = partial(substep.rollout_segment, model, **of)
            found = recompute(run, state, compensation, use_reentrant=False) if store else run(state, compensation)
        state, compensation, impulses = found
        total = add_impulses(total, impulses)
    return state, compensation, total


def check_finite(interval: FrameInterval, before: ClothState, after: ClothState) -> None:
    """Go through an interval again, substep by substep, to name the first vertex that was lost.

    Raises:
        SimulationDiverged: positions are not finite at its end.
    """
    if not bool(torch.isfinite(after.x.detach()).all()):
        raise _divergence(interval, before, after)


@torch.no_grad()
def _divergence(interval: FrameInterval, state: ClothState, after: ClothState) -> SimulationDiverged:
    drives, k, low = interval.sample_motion(), 0, None
    run = partial(substep.rollout_segment, interval.model) if interval.fused is None else interval.fused.stretch
    for k in range(interval.count):
        state, low, _ = run(state, low, interval.dt, _parts(drives, k, k + 1), 1)
        if not bool(torch.isfinite(state.x).all()):
            break
    else:  # searched at every substep, layers may have passed each other otherwise
        state = after
    gone = ~torch.isfinite(state.x).all(-1)
    vertex = int(gone.reshape(-1, gone.shape[-1]).any(0).nonzero()[0])
    return SimulationDiverged(
        f"simulation diverged at t = {float(interval.substep_times()[k + 1]):.6g} s",
        got=f"vertex {vertex} not finite after substep {k + 1} of {interval.count}",
        expected="finite positions",
        remedy="check the initial positions and the motion for jumps and units (m), or lower dt",
    )
