"""Substeps of the reference as CUDA graphs: hundreds of kernel launches become one.

A segment of some substeps is captured twice, once forward and once forward and backward, and replayed with other
numbers in the same memory. A backward pass computes each segment again from its initial state, as checkpoints do, so
the memory is that of the frames and of these states. A captured segment must not wait for a number. Segments in which
layers meet, or grippers open or close, therefore run without a graph.

A graph keeps what a part read of itself while it was captured, so it lives no longer than one simulation.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any, ClassVar, NamedTuple, cast

import torch
from torch import Tensor

from ..boundaries import PrescribedMotion
from ..dynamics import substep
from ..dynamics.contact.self_contact import ContactCandidates, find_contact_candidates
from ..dynamics.forces import Impulses, add_impulses
from ..dynamics.model import Model, tree_map
from ..errors import InvalidInput
from ..types import ClothState

SUBSTEPS_PER_GRAPH = range(8, 25)  # counts of which one is chosen that fits
WARMUP_SEGMENTS = 2  # segments that run without a graph before an equal one is captured: libraries are loaded then
MIN_REPLAYS = 8  # segments that must remain: a capture takes as long as about six of them

Replay = Callable[[], None]
Work = Callable[[], list[Tensor]]
Capture = Callable[[Work, torch.device], tuple[list[Tensor], Replay]]
SegmentEnd = tuple[ClothState, Tensor | None, Impulses]


class _CaptureFailed(RuntimeError):
    """A capture failed half way, after which no other should be tried in this process."""


@cache
def _capture_stream(device: torch.device) -> torch.cuda.Stream:
    """One stream for all captures: libraries keep a workspace for each stream."""
    return torch.cuda.Stream(device)


def capture_on_cuda(work: Work, device: torch.device) -> tuple[list[Tensor], Replay]:
    """Return the results of ``work`` in memory that each replay overwrites, and the replay.

    Raises:
        RuntimeError: ``work`` waits for the device.
    """
    with torch.cuda.device(device):
        side, now, mode = _capture_stream(device), torch.cuda.current_stream(), torch.cuda.get_sync_debug_mode()
        side.wait_stream(now)
        torch.cuda.set_sync_debug_mode("error")  # before the capture, which could not be undone
        try:
            with torch.cuda.stream(side):
                work()
        finally:
            torch.cuda.set_sync_debug_mode(mode)
        now.wait_stream(side)
        graph = torch.cuda.CUDAGraph()
        try:
            with (
                torch.cuda.stream(now),  # a capture that fails leaves its own stream current
                torch.cuda.graph(graph, stream=side, capture_error_mode="thread_local"),
            ):
                results = work()
        except Exception as error:
            raise _CaptureFailed(str(error)) from error
    return results, graph.replay


def segment_length(count: int) -> int:
    """Return the substeps of a segment such that few of ``count`` are left over."""
    return min(reversed(SUBSTEPS_PER_GRAPH), key=lambda length: count % length)


class GraphedRollout:
    """The captured segments of one simulation.

    Args:
        model: the model of all segments.
        substeps: substeps of the whole simulation.
        capture: records a calculation so that it can be repeated in its own memory; CUDA's capture by default.

    Attributes:
        parameters: tensors of the model that have gradients.
        leaves: what stands for them in the graphs' own model.
        own_model: the model that is captured, in memory of its own.
    """

    capture_is_broken: ClassVar[bool] = False

    def __init__(self, model: Model, substeps: int, capture: Capture = capture_on_cuda) -> None:
        self.model, self._substeps_left, self._capture = model, substeps, capture
        self.parameters: list[Tensor] = []
        self.leaves: list[Tensor] = []
        parts = model._replace(geometry=(), grid=None)  # nobody writes to these two
        own_model = cast("Model", tree_map(parts, self._own_tensor, buffers=True))
        self.own_model = own_model._replace(geometry=model.geometry, grid=model.grid)
        self._segments: dict[tuple[Any, ...], GraphedSegment] = {}
        self._counts: dict[tuple[Any, ...], int] = {}
        self._can_capture = True

    def rollout_segment(
        self,
        state: ClothState,
        compensation: Tensor | None,
        dt: float,
        prescribed: Mapping[str, PrescribedMotion],
        substeps: int,
        first: int,
    ) -> SegmentEnd | None:
        """Run substeps as ``dynamics.substep.rollout_segment`` does; return None where that function must run them."""
        closed = _constant_grips(prescribed, first, first + substeps)
        self._substeps_left -= substeps
        if not self.is_enabled or closed is None:
            return None
        if self.model.grid is not None and len(find_contact_candidates(self.model, self.model.grid, state.x).active):
            return None
        inputs = GraphInputs.of(state, compensation, dt, prescribed, first, substeps)
        key = (substeps, tuple(closed.items()), *((tuple(t.shape), t.dtype) for t in inputs.tensors))
        self._counts[key] = self._counts.get(key, 0) + 1
        if key not in self._segments:
            if self._counts[key] <= WARMUP_SEGMENTS or self._substeps_left < MIN_REPLAYS * substeps:
                return None
            self._segments[key] = GraphedSegment(self.own_model, inputs, closed, substeps, self._capture)
        segment = self._segments[key]
        try:
            segment.prepare(inputs, self.parameters, self.leaves)
        except Exception as error:  # whatever a user's part raises for a number that does not exist yet
            self._can_capture, GraphedRollout.capture_is_broken = False, isinstance(error, _CaptureFailed)
            line = str(error).partition("\n")[0]
            warnings.warn(f"no CUDA graph of the substeps, which are launched one by one: {line}", stacklevel=2)
            return None
        result = segment(inputs, self.parameters)
        if self.model.grid is not None and float(result.max_displacement) >= self.max_displacement_m:
            return None
        return result.state, result.compensation, result.impulses

    @property
    def is_enabled(self) -> bool:
        """Whether segments are captured: until a capture fails, and not where torch checks every number."""
        return self._can_capture and not GraphedRollout.capture_is_broken and not torch.is_anomaly_enabled()

    @property
    def max_displacement_m(self) -> float:
        """Displacement of a vertex [m] beyond which layers may meet that the last search did not list."""
        return 0.0 if self.model.grid is None else self.model.grid.search_skin / 2

    def _own_tensor(self, tensor: Tensor) -> Tensor:
        """What stands for a tensor of the model, in memory of its own: the cloth may be changed later."""
        if not tensor.requires_grad:
            return tensor.detach().clone()
        for parameter, leaf in zip(self.parameters, self.leaves, strict=True):
            if parameter is tensor:
                return leaf
        self.parameters.append(tensor)
        self.leaves.append(tensor.detach().requires_grad_())
        return self.leaves[-1]


class GraphInputs(NamedTuple):
    """Tensors that differ from segment to segment.

    Attributes:
        tensors: state, prescribed motions, substep and compensation, in this order.
        memory: names of the internal variables.
        boundaries: names of the prescribed boundaries.
        has_compensation: whether the last tensor is the compensation of the positions.
    """

    tensors: list[Tensor]
    memory: tuple[str, ...]
    boundaries: tuple[str, ...]
    has_compensation: bool

    @classmethod
    def of(
        cls,
        state: ClothState,
        compensation: Tensor | None,
        dt: float,
        prescribed: Mapping[str, PrescribedMotion],
        first: int,
        substeps: int,
    ) -> GraphInputs:
        """Collect the arguments of ``dynamics.substep.rollout_segment``."""
        rows = slice(first, first + substeps)
        variables = [state.x, state.v, state.d3, *state.memory.values()]
        motions = [t[..., rows, :, :] for motion in prescribed.values() for t in (motion.increment, motion.pose)]
        last = [state.x.new_full((), dt), *([] if compensation is None else [compensation])]
        return cls([*variables, *motions, *last], tuple(state.memory), tuple(prescribed), compensation is not None)

    @property
    def differentiable(self) -> int:
        """Count of the first tensors, which have gradients; the substep and the compensation have none."""
        return len(self.tensors) - 1 - self.has_compensation

    def unpack(
        self, tensors: Sequence[Tensor], closed: Mapping[str, bool], substeps: int
    ) -> tuple[ClothState, Tensor | None, float, dict[str, PrescribedMotion]]:
        """Return (state, compensation, dt, prescribed motions) of such tensors."""
        x, v, d3, *rest = tensors
        memory = {name: rest.pop(0) for name in self.memory}
        prescribed = {
            name: PrescribedMotion(rest.pop(0), rest.pop(0), (closed[name],) * substeps) for name in self.boundaries
        }
        compensation = rest[1] if self.has_compensation else None
        return ClothState(x, v, d3, memory), compensation, cast("float", rest[0]), prescribed


class _SegmentResult(NamedTuple):
    """The end of a segment.

    Attributes:
        state: after the substeps.
        compensation: of the positions; None in float64.
        impulses: by boundary.
        max_displacement: [] m, largest displacement of a vertex from the start, before the last substep.
    """

    state: ClothState
    compensation: Tensor | None
    impulses: Impulses
    max_displacement: Tensor


class _CapturedBackward(NamedTuple):
    """A captured backward pass.

    Attributes:
        seeds: memory for the gradients of the results.
        gradients: gradients of the inputs and leaves that have any.
        places: their numbers among all inputs and leaves.
        replay: repeats the pass.
    """

    seeds: list[Tensor]
    gradients: list[Tensor]
    places: list[int]
    replay: Replay


class GraphedSegment:
    """Some substeps, forward and backward.

    Args:
        model: the graphs' own model.
        like: inputs of the same shapes.
        closed: whether each gripper is closed.
        substeps: how many.
        capture: as for ``GraphedRollout``.
    """

    def __init__(
        self, model: Model, like: GraphInputs, closed: Mapping[str, bool], substeps: int, capture: Capture
    ) -> None:
        self.model, self.closed, self.substeps, self.capture = model, closed, substeps, capture
        self.unpack, self.differentiable = like._replace(tensors=[]).unpack, like.differentiable
        self.inputs = [torch.empty_like(t, memory_format=torch.contiguous_format) for t in like.tensors]
        # names of the internal variables and impulses of the results, and whether there is a compensation
        self.result_names: tuple[tuple[str, ...], tuple[str, ...], bool] = ((), (), False)
        self.forward: tuple[list[Tensor], Replay] | None = None
        self.backward: _CapturedBackward | None = None

    def __call__(self, inputs: GraphInputs, parameters: Sequence[Tensor]) -> _SegmentResult:
        """Return the end of the segment, differentiable in all inputs and parameters."""
        if _needs_backward(inputs, parameters):
            results = cast("Sequence[Tensor]", _ReplaySegment.apply(self, *inputs.tensors, *parameters))
        else:
            results = self.replay_forward(inputs.tensors)
        x, v, d3, max_displacement, *rest = results
        memory, boundaries, has_compensation = self.result_names
        state = ClothState(x, v, d3, {name: rest.pop(0) for name in memory})
        impulses = {name: rest.pop(0) for name in boundaries}
        return _SegmentResult(state, rest[0] if has_compensation else None, impulses, max_displacement)

    def replay_forward(self, inputs: Sequence[Tensor]) -> list[Tensor]:
        """Return the results of the substeps as a list of tensors."""
        self._fill(inputs)
        results, replay = cast("tuple[list[Tensor], Replay]", self.forward)
        replay()
        return [t.clone() for t in results]

    def prepare(self, inputs: GraphInputs, parameters: Sequence[Tensor], leaves: Sequence[Tensor]) -> None:
        """Capture what is not captured yet.

        A backward pass is captured before it is needed, because threads of its own run it.
        """
        if self.forward is None:
            self._fill(inputs.tensors)
            with torch.no_grad():
                self.forward = self.capture(lambda: self._run(self.inputs), self.inputs[0].device)
        if self.backward is None and _needs_backward(inputs, parameters):
            self.backward = self._capture_backward(self.forward[0], leaves)

    def replay_backward(
        self, inputs: Sequence[Tensor], seeds: Sequence[Tensor | None], leaves: int
    ) -> list[Tensor | None]:
        """Return gradients of all inputs and of so many leaves, from those of the results (``seeds``)."""
        self._fill(inputs)
        slots, gradients, places, replay = cast("_CapturedBackward", self.backward)
        for slot, seed in zip(slots, seeds, strict=True):
            slot.zero_() if seed is None else slot.copy_(seed)
        replay()
        out: list[Tensor | None] = [None] * (len(inputs) + leaves)
        for place, gradient in zip(places, gradients, strict=True):
            out[place] = gradient.clone()
        return out

    def _capture_backward(self, results: Sequence[Tensor], leaves: Sequence[Tensor]) -> _CapturedBackward:
        seeds, differentiable = [torch.zeros_like(t) for t in results], self.differentiable
        places: list[int] = []

        def work() -> list[Tensor]:
            # a caller's checkpoint or offloading of saved tensors must not reach this graph
            with torch.enable_grad(), torch.autograd.graph.saved_tensors_hooks(lambda t: t, lambda t: t):
                inputs = [t.detach().requires_grad_(k < differentiable) for k, t in enumerate(self.inputs)]
                pairs = [(end, seed) for end, seed in zip(self._run(inputs), seeds, strict=True) if end.requires_grad]
                ends, by = zip(*pairs, strict=True)
                _check_leaves(ends, [*inputs, *leaves])
                gradients = torch.autograd.grad(ends, [*inputs[:differentiable], *leaves], by, allow_unused=True)
            numbers = [*range(differentiable), *range(len(inputs), len(inputs) + len(leaves))]
            places[:] = [k for k, gradient in zip(numbers, gradients, strict=True) if gradient is not None]
            return [gradient for gradient in gradients if gradient is not None]

        gradients, replay = self.capture(work, self.inputs[0].device)
        return _CapturedBackward(seeds, gradients, places, replay)

    def _fill(self, inputs: Sequence[Tensor]) -> None:
        for slot, tensor in zip(self.inputs, inputs, strict=True):
            slot.copy_(tensor.detach())

    def _run(self, inputs: Sequence[Tensor]) -> list[Tensor]:
        state, compensation, dt, prescribed = self.unpack(inputs, self.closed, self.substeps)
        total: Impulses = {}
        start, max_displacement = state.x.detach(), state.x.new_zeros(())
        layers = _no_layers(self.model, state.x)
        for k in range(self.substeps):
            max_displacement = torch.maximum(max_displacement, (state.x.detach() - start).abs().max())
            state, compensation, impulses = substep.compensated_step(
                self.model, state, compensation, dt, prescribed, k, layers
            )
            total = add_impulses(total, impulses)
        self.result_names = tuple(state.memory), tuple(total), compensation is not None
        last = [] if compensation is None else [compensation]
        return [state.x, state.v, state.d3, max_displacement, *state.memory.values(), *total.values(), *last]


class _ReplaySegment(torch.autograd.Function):
    """A segment as one operation."""

    @staticmethod
    def forward(ctx: Any, segment: GraphedSegment, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Replay; ``inputs``: those of the segment, and the parameters in the place of the leaves."""
        ctx.segment = segment
        ctx.save_for_backward(*inputs)  # all of them: torch refuses what has been changed since
        results = segment.replay_forward(inputs[: len(segment.inputs)])
        ctx.mark_non_differentiable(results[3], *(results[-1:] if segment.result_names[2] else []))
        ctx.set_materialize_grads(False)
        return tuple(results)

    @staticmethod
    def backward(ctx: Any, *seeds: Tensor | None) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Compute the segment again from its start, and its gradients."""
        if torch.is_grad_enabled():
            got, remedy = "create_graph=True", 'engine="reference"'
            raise InvalidInput("gradient of a gradient through CUDA graphs", got=got, expected="one", remedy=remedy)
        count, inputs = len(ctx.segment.inputs), ctx.saved_tensors
        return None, *ctx.segment.replay_backward(inputs[:count], seeds, len(inputs) - count)


def _needs_backward(inputs: GraphInputs, parameters: Sequence[Tensor]) -> bool:
    """Whether a backward pass may follow."""
    return torch.is_grad_enabled() and any(t.requires_grad for t in (*inputs.tensors, *parameters))


def _check_leaves(ends: Sequence[Tensor], known: Sequence[Tensor]) -> None:
    """Refuse a gradient that would be dropped: that of a tensor which a user's part hides.

    Raises:
        RuntimeError: ``ends`` depend on a leaf that is not ``known``.
    """
    ids, visited, pending = {id(t) for t in known}, set(), [end.grad_fn for end in ends]
    while pending:
        node = pending.pop()
        if node is None or node in visited:
            continue
        visited.add(node)
        leaf = getattr(node, "variable", None)
        if leaf is not None and id(leaf) not in ids:
            raise RuntimeError(f"a part has a tensor {tuple(leaf.shape)} with a gradient that is no parameter of it")
        pending += [before for before, _ in node.next_functions]


def _constant_grips(prescribed: Mapping[str, PrescribedMotion], first: int, last: int) -> dict[str, bool] | None:
    """Whether each gripper is closed; None where one changes."""
    out = {}
    for name, motion in prescribed.items():
        flags = set(motion.closed[first:last])
        if len(flags) != 1:
            return None
        out[name] = flags.pop()
    return out


def _no_layers(model: Model, x: Tensor) -> ContactCandidates | None:
    """An empty list of triangles in contact; None without contact."""
    if model.grid is None:
        return None
    empty = torch.empty(0, dtype=torch.int64, device=x.device)
    return ContactCandidates(empty, empty, empty.expand(3, 0), empty.int(), x)
