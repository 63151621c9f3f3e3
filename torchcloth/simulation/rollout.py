"""Rollouts: the substeps between frames, their checkpoints, and the search for the substep that went wrong."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial, reduce
from itertools import pairwise
from math import ceil
from typing import NamedTuple

import torch
from torch import Tensor
from torch.utils import checkpoint as torch_checkpoint

from .._utils.torch_modes import under_torch_transform
from ..boundaries import PrescribedMotion, sample_trajectory
from ..dynamics import substep
from ..dynamics.contact.self_contact import SUBSTEPS_PER_CHECKPOINT
from ..dynamics.forces import Impulses, add_impulses
from ..dynamics.model import Model, freeze_parameters
from ..engine.cuda_graphs import GraphedRollout, segment_length
from ..engine.dispatch import EngineChoice
from ..engine.fused import FusedEngine, may_recompute
from ..errors import SimulationDiverged
from ..types import ClothState, Rollout, Trajectory
from .argument_checks import check_extent, check_substeps

MAX_VERTEX_SUBSTEPS_PER_CALL = 4_000_000  # a call of the engine cannot be interrupted
MIN_COUNTED_VERTICES = 250  # smaller meshes count as this many
SCENES_PER_DEVICE = 128  # that a device computes at the same time
SUBSTEPS_BETWEEN_STABILITY_CHECKS = 64  # of a material that yields: its plastic set shortens the stable step


def subdivide_intervals(
    frames: Sequence[float], counts: Sequence[int]
) -> tuple[list[float], list[int], tuple[int, ...]]:
    """Insert frames so that at most SUBSTEPS_BETWEEN_STABILITY_CHECKS substeps lie between two.

    Args:
        frames: frame times [s].
        counts: substeps between them.

    Returns:
        All frame times [s], the substeps between them, and the indices of the given frames among all.
    """
    all_frames, all_counts, given = [frames[0]], [], [0]
    for (start, end), count in zip(pairwise(frames), counts, strict=True):
        parts = ceil(count / SUBSTEPS_BETWEEN_STABILITY_CHECKS)
        ends = [count * (k + 1) // parts for k in range(parts)]
        all_counts += [last - first for first, last in pairwise([0, *ends])]
        all_frames += [*(start + (end - start) * last / count for last in ends[:-1]), end]
        given.append(len(all_frames) - 1)
    return all_frames, all_counts, tuple(given)


class FrameInterval(NamedTuple):
    """The time between two frames, in equal substeps.

    Attributes:
        model: the model.
        motion: trajectories by boundary.
        start: [s].
        end: [s].
        count: number of substeps.
        fused: the engine that runs them; None: the reference.
        prescribed: ``motion`` on the substeps, where it has been sampled already.
        graphs: CUDA graphs of the reference's substeps; None: they are launched one by one.
        first_substep: number of the first substep in the whole simulation.
    """

    model: Model
    motion: Mapping[str, Trajectory]
    start: float
    end: float
    count: int
    fused: FusedEngine | None = None
    prescribed: Mapping[str, PrescribedMotion] | None = None
    graphs: GraphedRollout | None = None
    first_substep: int = 0

    @property
    def dt(self) -> float:
        """Length of a substep [s]."""
        return (self.end - self.start) / self.count

    def substep_times(self) -> Tensor:
        """Return the ends of the substeps, [count + 1] s."""
        return torch.linspace(self.start, self.end, self.count + 1, dtype=torch.float64)

    def sample_motion(self) -> dict[str, PrescribedMotion]:
        """Return the prescribed motion on the substeps, by boundary."""
        return dict(_sample(self.motion, self.substep_times()) if self.prescribed is None else self.prescribed)


def _sample(motion: Mapping[str, Trajectory], times: Tensor) -> dict[str, PrescribedMotion]:
    return {name: sample_trajectory(trajectory, times) for name, trajectory in motion.items()}


def _slice(prescribed: Mapping[str, PrescribedMotion], first: int, last: int) -> dict[str, PrescribedMotion]:
    rows = slice(first, last)
    return {
        name: PrescribedMotion(whole.increment[..., rows, :, :], whole.pose[..., rows, :, :], whole.closed[rows])
        for name, whole in prescribed.items()
    }


class RolloutSchedule(NamedTuple):
    """A simulation whose arguments have been checked.

    Attributes:
        model: the model.
        motion: trajectories by boundary.
        frames: frame times [s].
        counts: substeps between the frames.
        state: the state at the first frame, with all batch dimensions.
        choice: the engine.
        max_extent: extent of the cloth for which the contact grid has room [m].
        step_for: returns the longest stable substep [s] from a state on; None: the same for all states.
        requested_frames: indices of the frames to return; None: all.
        graphs: CUDA graphs of the reference's substeps; None: they are launched one by one.
    """

    model: Model
    motion: Mapping[str, Trajectory]
    frames: list[float]
    counts: list[int]
    state: ClothState
    choice: EngineChoice
    max_extent: float
    step_for: Callable[[ClothState], float] | None = None
    requested_frames: tuple[int, ...] | None = None
    graphs: GraphedRollout | None = None

    def iterate_intervals(self, current_state: Callable[[], ClothState]) -> Iterator[FrameInterval]:
        """Yield the intervals in order, with more substeps where ``step_for`` asks for them.

        ``current_state`` returns the state at the start of the next interval.
        """
        prescribed, first = self.sample_motion(), 0
        for interval in self._list_intervals():
            last = first + interval.count
            needed, span = 0, interval.end - interval.start
            if self.step_for is not None:
                longest_step = self.step_for(current_state())
                check_substeps(span, longest_step)
                needed = ceil(span / longest_step - 1e-9)
            if needed > interval.count:
                yield interval._replace(count=needed, first_substep=first)
            else:
                yield interval._replace(prescribed=_slice(prescribed, first, last), first_substep=first)
            first = last

    def iterate_blocks(self) -> Iterator[tuple[list[FrameInterval], dict[str, PrescribedMotion]]]:
        """Yield blocks of intervals that one call of the engine may take, each with its prescribed motion."""
        prescribed, first, last, block = self.sample_motion(), 0, 0, []
        vertices = self.state.x.numel() // 3
        if self.choice.fused is not None and self.choice.fused.is_on_device:
            vertices //= SCENES_PER_DEVICE
        max_substeps = MAX_VERTEX_SUBSTEPS_PER_CALL // max(vertices, MIN_COUNTED_VERTICES)
        for interval in (*self._list_intervals(), None):
            if block and (interval is None or last - first + interval.count > max_substeps):
                yield block, _slice(prescribed, first, last)
                first, block = last, []
            if interval is not None:
                last, block = last + interval.count, [*block, interval]

    @property
    def times(self) -> list[float]:
        """Times of the requested frames [s]."""
        return self.frames if self.requested_frames is None else [self.frames[k] for k in self.requested_frames]

    def at_requested_frames(
        self, states: Sequence[ClothState], impulses: Sequence[Impulses]
    ) -> tuple[Sequence[ClothState], Sequence[Impulses]]:
        """Return the states at the requested frames, and the impulses summed between them."""
        if self.requested_frames is None:
            return states, impulses
        between = [reduce(add_impulses, impulses[first:last], {}) for first, last in pairwise(self.requested_frames)]
        return [states[k] for k in self.requested_frames], between

    def sample_motion(self) -> dict[str, PrescribedMotion]:
        """Sample the motion on all substeps at once, which costs what one interval does."""
        intervals = self._list_intervals()
        times = torch.cat([*(i.substep_times()[:-1] for i in intervals), intervals[-1].substep_times()[-1:]])
        return _sample(self.motion, times)

    def _list_intervals(self) -> list[FrameInterval]:
        """Return the intervals between frames, whose motion is not yet sampled."""
        return [
            FrameInterval(self.model, self.motion, start, end, count, self.choice.fused, None, self.graphs)
            for (start, end), count in zip(pairwise(self.frames), self.counts, strict=True)
        ]

    def check_extent(self, state: ClothState) -> None:
        """Refuse a cloth wider than the contact grid, which has been torn apart.

        Raises:
            SimulationDiverged: the cloth is wider than ``max_extent``.
        """
        if self.max_extent < float("inf"):
            check_extent(state.x, self.max_extent)


def run_schedule(schedule: RolloutSchedule, checkpoint: bool) -> Rollout:
    """Run a simulation, and return its states and wrenches at the requested frames.

    Raises:
        SimulationDiverged: the state is no longer finite.
    """
    fused, state, states, impulses, compensation = schedule.choice.fused, schedule.state, [schedule.state], [], None
    # with a contact grid or plasticity, the state must be looked at between frames
    is_unchecked = schedule.max_extent == float("inf") and schedule.step_for is None
    if fused is not None and is_unchecked and fused.is_plain(state, schedule.motion):
        for block, prescribed in schedule.iterate_blocks():
            results = _run_fused_block(fused, block, states[-1], compensation, prescribed)
            states += [state for state, _, _ in results]
            impulses += [impulse for _, _, impulse in results]
            compensation = results[-1][1]
        return collect_rollout(schedule, states, impulses)
    for interval in schedule.iterate_intervals(lambda: states[-1]):
        state, compensation, impulse = advance_interval(interval, state, compensation, checkpoint)
        schedule.check_extent(state)
        states.append(state)
        impulses.append(impulse)
    return collect_rollout(schedule, states, impulses)


def _run_fused_block(
    fused: FusedEngine,
    block: Sequence[FrameInterval],
    state: ClothState,
    compensation: Tensor | None,
    prescribed: Mapping[str, PrescribedMotion],
) -> list[tuple[ClothState, Tensor | None, Impulses]]:
    """Simulate a block of intervals in one call, and return what ``advance_interval`` returns for each."""
    counts = torch.tensor([i.count for i in block])
    steps = torch.tensor([i.dt for i in block], dtype=torch.float64).repeat_interleave(counts)
    results = fused.frames(state, compensation, steps, prescribed, tuple(counts.cumsum(0).tolist()))
    ends = [end for end, *_ in results]
    if not bool(torch.isfinite(torch.stack([end.x for end in ends])).all()):
        first = 0
        for interval, start, end in zip(block, [state, *ends], ends, strict=False):
            last = first + interval.count
            check_finite(interval._replace(prescribed=_slice(prescribed, first, last)), start, end)
            first = last
    return results


def collect_rollout(schedule: RolloutSchedule, states: Sequence[ClothState], impulses: Sequence[Impulses]) -> Rollout:
    """Assemble a rollout from the states at all frames and the impulses between them."""
    states, impulses = schedule.at_requested_frames(states, impulses)
    x, v = (torch.stack(part, dim=-3) for part in ([s.x for s in states], [s.v for s in states]))
    zero, wrench = x.new_zeros(*x.shape[:-3], 6), {}
    durations = [end - start for start, end in pairwise(schedule.times)]
    for name in (name for name, boundary in schedule.model.boundaries.items() if boundary.is_prescribed):
        means = [-j[name] / d if name in j else zero for j, d in zip(impulses, durations, strict=True)]
        wrench[name] = torch.stack([zero, *(mean.expand_as(zero) for mean in means)], dim=-2)
    return Rollout(torch.tensor(schedule.times, dtype=torch.float64), x, v, wrench, states[-1])


def advance_interval(
    interval: FrameInterval, state: ClothState, compensation: Tensor | None, checkpoint: bool
) -> tuple[ClothState, Tensor | None, Impulses]:
    """Simulate one interval.

    Args:
        interval: the interval.
        state: at its start.
        compensation: rounding error of the positions (``substep.rollout_segment``).
        checkpoint: recompute substeps in the backward pass instead of storing them.

    Returns:
        The state at the end, its rounding error, and the impulses summed over the interval.

    Raises:
        SimulationDiverged: positions at the end are not finite.
    """
    start, prescribed = state, interval.sample_motion()
    if interval.fused is None:
        state, compensation, total = _run_reference(interval, state, compensation, prescribed, checkpoint)
    else:
        run = partial(interval.fused.rollout_segment, checkpoint=checkpoint, first_substep=interval.first_substep)
        state, compensation, total = run(state, compensation, interval.dt, prescribed, interval.count)
    check_finite(interval, start, state)
    return state, compensation, total


def _run_reference(
    interval: FrameInterval,
    state: ClothState,
    compensation: Tensor | None,
    prescribed: Mapping[str, PrescribedMotion],
    checkpoint: bool,
) -> tuple[ClothState, Tensor | None, Impulses]:
    total: Impulses = {}
    recomputes, model = checkpoint and may_recompute(), interval.model
    if model.grid is not None:
        model = model._replace(grid=model.grid._replace(first_substep=interval.first_substep))
    model = freeze_parameters(model) if recomputes else model
    graphs = None if under_torch_transform() else interval.graphs
    chunk = segment_length(interval.count) if graphs is not None and graphs.is_enabled else SUBSTEPS_PER_CHECKPOINT
    for first in range(0, interval.count, chunk):
        segment = {
            "dt": interval.dt,
            "prescribed": prescribed,
            "substeps": min(chunk, interval.count - first),
            "first": first,
        }
        result = None if graphs is None else graphs.rollout_segment(state, compensation, **segment)
        if result is None:
            run = partial(substep.rollout_segment, model, **segment)
            if recomputes:
                result = torch_checkpoint.checkpoint(run, state, compensation, use_reentrant=False)
            else:
                result = run(state, compensation)
        state, compensation, impulses = result
        total = add_impulses(total, impulses)
    return state, compensation, total


def check_finite(interval: FrameInterval, start: ClothState, end: ClothState) -> None:
    """Check the positions at the end of an interval; if some are not finite, repeat it to name the first vertex.

    Raises:
        SimulationDiverged: positions at the end are not finite.
    """
    if not bool(torch.isfinite(end.x.detach()).all()):
        raise _find_divergence(interval, start, end)


@torch.no_grad()
def _find_divergence(interval: FrameInterval, state: ClothState, end: ClothState) -> SimulationDiverged:
    prescribed, k, compensation = interval.sample_motion(), 0, None
    run = partial(substep.rollout_segment, interval.model) if interval.fused is None else interval.fused.rollout_segment
    for k in range(interval.count):
        state, compensation, _ = run(state, compensation, interval.dt, _slice(prescribed, k, k + 1), 1)
        if not bool(torch.isfinite(state.x).all()):
            break
    else:  # here layers are searched at every substep, so they may have passed each other otherwise
        state = end
    diverged = ~torch.isfinite(state.x).all(-1)
    vertex = int(diverged.reshape(-1, diverged.shape[-1]).any(0).nonzero()[0])
    return SimulationDiverged(
        f"simulation diverged at t = {float(interval.substep_times()[k + 1]):.6g} s",
        got=f"vertex {vertex} not finite after substep {k + 1} of {interval.count}",
        expected="finite positions",
        remedy="check the initial positions and the motion for jumps and units (m), or lower dt",
    )
