"""Substeps of the reference as CUDA graphs: hundreds of launches become one.

A unit of some substeps is captured twice, once forward and once forward and back, and replayed with other numbers in
the same memory. A backward pass computes each unit again from the state where it began, as checkpoints do, so memory
is that of the frames and the units' states. What is captured must not wait for a number: units in which layers meet,
or grippers open or close, run as they do elsewhere.

A graph keeps what a part read of itself while it was captured, so it lives no longer than one simulation.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any, ClassVar, NamedTuple, cast

import torch
from torch import Tensor

from ..boundaries import Drive
from ..dynamics import substep
from ..dynamics.contact.self_contact import Layers, near_layers
from ..dynamics.forces import Impulses, added
from ..dynamics.model import Model, mapped
from ..errors import InvalidInput
from ..types import ClothState

UNIT = range(8, 25)  # substeps, of which one count is chosen that fits
SOON = 2  # units that run as they are before one like them is captured: libraries are awake then
PAYS = 8  # units that must be left: a capture takes as long as some six of them

Replay = Callable[[], None]
Work = Callable[[], list[Tensor]]
Capture = Callable[[Work, torch.device], tuple[list[Tensor], Replay]]
Stretch = tuple[ClothState, Tensor | None, Impulses]


class _Broken(RuntimeError):
    """A capture failed half way, after which no other should be tried in this process."""


@cache
def _stream(device: torch.device) -> torch.cuda.Stream:
    """One for all captures: libraries keep a workspace for each."""
    return torch.cuda.Stream(device)


def on_cuda(work: Work, device: torch.device) -> tuple[list[Tensor], Replay]:
    """What ``work`` gives, in memory that each replay overwrites, and the replay.

    Raises:
        RuntimeError: ``work`` waits for the device.
    """
    with torch.cuda.device(device):
        side, now, mode = _stream(device), torch.cuda.current_stream(), torch.cuda.get_sync_debug_mode()
        side.wait_stream(now)
        torch.cuda.set_sync_debug_mode("error")  # before anything is captured, which could not be taken back
        try:
            with torch.cuda.stream(side):
                work()
        finally:
            torch.cuda.set_sync_debug_mode(mode)
        now.wait_stream(side)
        graph = torch.cuda.CUDAGraph()
        try:
            with (
                torch.cuda.stream(now),  # a capture that fails leaves its own
                torch.cuda.graph(graph, stream=side, capture_error_mode="thread_local"),
            ):
                found = work()
        except Exception as error:
            raise _Broken(str(error)) from error
    return found, graph.replay


def unit_of(count: int) -> int:
    """Substeps of a unit, of which ``count`` leaves fewest over."""
    return min(reversed(UNIT), key=lambda unit: count % unit)


class Graphs:
    """The units of one simulation.

    Args:
        model: of all of them.
        substeps: of all of it.
        capture: another way than CUDA's to repeat a calculation in its own memory.
    """

    broken: ClassVar[bool] = False

    def __init__(self, model: Model, substeps: int, capture: Capture = on_cuda) -> None:
        self.model, self._left, self._capture = model, substeps, capture
        self.given: list[Tensor] = []  # what of the model has a gradient
        self.leaves: list[Tensor] = []  # what stands for it in the graphs' own model
        parts = model._replace(geometry=(), grid=None)  # nobody writes to these
        own = cast("Model", mapped(parts, self._kept, buffers=True))
        self.own = own._replace(geometry=model.geometry, grid=model.grid)
        self._units: dict[tuple[Any, ...], Unit] = {}
        self._seen: dict[tuple[Any, ...], int] = {}
        self._able = True

    def stretch(
        self, state: ClothState, lost: Tensor | None, dt: float, drives: Mapping[str, Drive], substeps: int, first: int
    ) -> Stretch | None:
        """As ``functional.stretch``; None where it must run there."""
        closed = _constant(drives, first, first + substeps)
        self._left -= substeps
        if not self.able or closed is None:
            return None
        if self.model.grid is not None and len(near_layers(self.model, self.model.grid, state.x).active):
            return None
        moving = Moving.of(state, lost, dt, drives, first, substeps)
        key = (substeps, tuple(closed.items()), *((tuple(t.shape), t.dtype) for t in moving.tensors))
        self._seen[key] = self._seen.get(key, 0) + 1
        if key not in self._units:
            if self._seen[key] <= SOON or self._left < PAYS * substeps:
                return None
            self._units[key] = Unit(self.own, moving, closed, substeps, self._capture)
        unit = self._units[key]
        try:
            unit.get_ready(moving, self.given, self.leaves)
        except Exception as error:  # whatever a user's part says to a number that is not there yet
            self._able, Graphs.broken = False, isinstance(error, _Broken)
            line = str(error).partition("\n")[0]
            warnings.warn(f"no CUDA graph of the substeps, which are launched one by one: {line}", stacklevel=2)
            return None
        found = unit(moving, self.given)
        if self.model.grid is not None and float(found.farthest) >= self.reach:
            return None
        return found.state, found.lost, found.impulses

    @property
    def able(self) -> bool:
        """Until a capture fails; nor where torch looks at every number."""
        return self._able and not Graphs.broken and not torch.is_anomaly_enabled()

    @property
    def reach(self) -> float:
        """[m], that a vertex may move before layers may meet which did not."""
        return 0.0 if self.model.grid is None else self.model.grid.skin / 2

    def _kept(self, tensor: Tensor) -> Tensor:
        """What stands for a tensor of the model, in memory of its own: the cloth may be changed later."""
        if not tensor.requires_grad:
            return tensor.detach().clone()
        for given, leaf in zip(self.given, self.leaves, strict=True):
            if given is tensor:
                return leaf
        self.given.append(tensor)
        self.leaves.append(tensor.detach().requires_grad_())
        return self.leaves[-1]


class Moving(NamedTuple):
    """What differs from unit to unit, in one list of tensors."""

    tensors: list[Tensor]
    memory: tuple[str, ...]
    driven: tuple[str, ...]
    keeps: bool  # whether there is what was lost

    @classmethod
    def of(
        cls,
        state: ClothState,
        lost: Tensor | None,
        dt: float,
        drives: Mapping[str, Drive],
        first: int,
        substeps: int,
    ) -> Moving:
        """What ``functional.stretch`` is called with."""
        some = slice(first, first + substeps)
        fields = [state.x, state.v, state.d3, *state.memory.values()]
        moves = [t[..., some, :, :] for drive in drives.values() for t in (drive.increment, drive.pose)]
        last = [state.x.new_full((), dt), *([] if lost is None else [lost])]
        return cls([*fields, *moves, *last], tuple(state.memory), tuple(drives), lost is not None)

    @property
    def tracked(self) -> int:
        """Tensors, the first ones, that have gradients: time and rounding have none."""
        return len(self.tensors) - 1 - self.keeps

    def read(
        self, tensors: Sequence[Tensor], closed: Mapping[str, bool], substeps: int
    ) -> tuple[ClothState, Tensor | None, float, dict[str, Drive]]:
        """(state, lost, dt, drives) of such tensors."""
        x, v, d3, *left = tensors
        memory = {name: left.pop(0) for name in self.memory}
        drives = {name: Drive(left.pop(0), left.pop(0), (closed[name],) * substeps) for name in self.driven}
        return ClothState(x, v, d3, memory), left[1] if self.keeps else None, cast("float", left[0]), drives


class _Found(NamedTuple):
    """The end of a unit."""

    state: ClothState
    lost: Tensor | None
    impulses: Impulses
    farthest: Tensor  # [] m, that a vertex was from where the unit began, before its last substep


class _Back(NamedTuple):
    """A backward pass that is captured."""

    asked: list[Tensor]  # where the gradients of what comes out go
    found: list[Tensor]  # gradients of what went in
    places: list[int]  # of these among all that moves and the leaves
    replay: Replay


class Unit:
    """Some substeps, forward and back."""

    def __init__(self, model: Model, like: Moving, closed: Mapping[str, bool], substeps: int, capture: Capture) -> None:
        self.model, self.closed, self.substeps, self.capture = model, closed, substeps, capture
        self.read, self.tracked = like._replace(tensors=[]).read, like.tracked
        self.inputs = [torch.empty_like(t, memory_format=torch.contiguous_format) for t in like.tensors]
        self.places: tuple[tuple[str, ...], tuple[str, ...], bool] = ((), (), False)  # of what it gives
        self.forward: tuple[list[Tensor], Replay] | None = None
        self.backward: _Back | None = None

    def __call__(self, moving: Moving, given: Sequence[Tensor]) -> _Found:
        """The end of the unit; differentiable in all that moves and in what is ``given`` in the place of leaves."""
        if _watched(moving, given):
            found = cast("Sequence[Tensor]", _Replayed.apply(self, *moving.tensors, *given))
        else:
            found = self.replayed(moving.tensors)
        x, v, d3, farthest, *left = found
        memory, driven, keeps = self.places
        state = ClothState(x, v, d3, {name: left.pop(0) for name in memory})
        impulses = {name: left.pop(0) for name in driven}
        return _Found(state, left[0] if keeps else None, impulses, farthest)

    def replayed(self, moving: Sequence[Tensor]) -> list[Tensor]:
        """Forward."""
        self._fill(moving)
        found, replay = cast("tuple[list[Tensor], Replay]", self.forward)
        replay()
        return [t.clone() for t in found]

    def get_ready(self, moving: Moving, given: Sequence[Tensor], leaves: Sequence[Tensor]) -> None:
        """Capture what is not captured yet; for a backward pass before it, for threads of its own run that."""
        if self.forward is None:
            self._fill(moving.tensors)
            with torch.no_grad():
                self.forward = self.capture(lambda: self._run(self.inputs), self.inputs[0].device)
        if self.backward is None and _watched(moving, given):
            self.backward = self._captured_back(self.forward[0], leaves)

    def pulled_back(self, moving: Sequence[Tensor], grads: Sequence[Tensor | None], leaves: int) -> list[Tensor | None]:
        """Gradients of all that moves and of so many leaves, from those of what ``replayed`` gives."""
        self._fill(moving)
        asked, found, places, replay = cast("_Back", self.backward)
        for slot, grad in zip(asked, grads, strict=True):
            slot.zero_() if grad is None else slot.copy_(grad)
        replay()
        out: list[Tensor | None] = [None] * (len(moving) + leaves)
        for place, grad in zip(places, found, strict=True):
            out[place] = grad.clone()
        return out

    def _captured_back(self, ends: Sequence[Tensor], leaves: Sequence[Tensor]) -> _Back:
        asked, tracked = [torch.zeros_like(t) for t in ends], self.tracked
        places: list[int] = []

        def work() -> list[Tensor]:
            # what a caller's checkpoint or offloading does with saved tensors is none of this
            with torch.enable_grad(), torch.autograd.graph.saved_tensors_hooks(lambda t: t, lambda t: t):
                own = [t.detach().requires_grad_(k < tracked) for k, t in enumerate(self.inputs)]
                told = [(end, grad) for end, grad in zip(self._run(own), asked, strict=True) if end.requires_grad]
                ends, by = zip(*told, strict=True)
                _check_leaves(ends, [*own, *leaves])
                found = torch.autograd.grad(ends, [*own[:tracked], *leaves], by, allow_unused=True)
            at = [*range(tracked), *range(len(own), len(own) + len(leaves))]
            places[:] = [k for k, grad in zip(at, found, strict=True) if grad is not None]
            return [grad for grad in found if grad is not None]

        found, replay = self.capture(work, self.inputs[0].device)
        return _Back(asked, found, places, replay)

    def _fill(self, moving: Sequence[Tensor]) -> None:
        for slot, now in zip(self.inputs, moving, strict=True):
            slot.copy_(now.detach())

    def _run(self, inputs: Sequence[Tensor]) -> list[Tensor]:
        state, lost, dt, drives = self.read(inputs, self.closed, self.substeps)
        total: Impulses = {}
        start, farthest, layers = state.x.detach(), state.x.new_zeros(()), _none(self.model, state.x)
        for k in range(self.substeps):
            farthest = torch.maximum(farthest, (state.x.detach() - start).abs().max())
            state, lost, impulses = substep.substep(self.model, state, lost, dt, drives, k, layers)
            total = added(total, impulses)
        self.places = tuple(state.memory), tuple(total), lost is not None
        kept_back = [] if lost is None else [lost]
        return [state.x, state.v, state.d3, farthest, *state.memory.values(), *total.values(), *kept_back]


class _Replayed(torch.autograd.Function):
    """A unit as one operation."""

    @staticmethod
    def forward(ctx: Any, unit: Unit, *inputs: Tensor) -> tuple[Tensor, ...]:
        """``inputs``: all that moves, and what stands in the model where the leaves do."""
        ctx.unit = unit
        ctx.save_for_backward(*inputs)  # all of it: torch refuses what has been changed since
        found = unit.replayed(inputs[: len(unit.inputs)])
        ctx.mark_non_differentiable(found[3], *(found[-1:] if unit.places[2] else []))
        ctx.set_materialize_grads(False)
        return tuple(found)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Computed again from where the unit began."""
        if torch.is_grad_enabled():
            got, remedy = "create_graph=True", 'engine="reference"'
            raise InvalidInput("gradient of a gradient through CUDA graphs", got=got, expected="one", remedy=remedy)
        count, inputs = len(ctx.unit.inputs), ctx.saved_tensors
        return None, *ctx.unit.pulled_back(inputs[:count], grads, len(inputs) - count)


def _watched(moving: Moving, given: Sequence[Tensor]) -> bool:
    """Whether a backward pass may come."""
    return torch.is_grad_enabled() and any(t.requires_grad for t in (*moving.tensors, *given))


def _check_leaves(ends: Sequence[Tensor], known: Sequence[Tensor]) -> None:
    """Refuse a gradient that would be lost: of what a user's part keeps where nobody looks.

    Raises:
        RuntimeError: ``ends`` depend on a leaf that is not ``known``.
    """
    mine, seen, open_ = {id(t) for t in known}, set(), [end.grad_fn for end in ends]
    while open_:
        node = open_.pop()
        if node is None or node in seen:
            continue
        seen.add(node)
        leaf = getattr(node, "variable", None)
        if leaf is not None and id(leaf) not in mine:
            raise RuntimeError(f"a part has a tensor {tuple(leaf.shape)} with a gradient that is no parameter of it")
        open_ += [before for before, _ in node.next_functions]


def _constant(drives: Mapping[str, Drive], first: int, last: int) -> dict[str, bool] | None:
    """Whether each gripper is closed; None where one changes."""
    out = {}
    for name, drive in drives.items():
        flags = set(drive.closed[first:last])
        if len(flags) != 1:
            return None
        out[name] = flags.pop()
    return out


def _none(model: Model, x: Tensor) -> Layers | None:
    """No layers near each other."""
    if model.grid is None:
        return None
    empty = torch.empty(0, dtype=torch.int64, device=x.device)
    return Layers(empty, empty, empty.expand(3, 0), empty.int(), x)
