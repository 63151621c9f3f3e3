"""The fused engine in the place of ``functional.rollout``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import groupby

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint as recompute

from ..boundaries import Drive
from ..dynamics import Impulses
from ..model import Model
from ..types import ClothState
from . import binding, running
from .lowering import Lowering, fitted
from .operators import Rollout
from .outside import Outside
from .program import Field

CHUNK = 48  # substeps between checkpoints where torch has a part in each of them


class Fused:
    """A model on the engine, for the length of one call of the cloth.

    Attributes:
        outside: the parts that torch computes in every substep; None: there are none, and the engine runs by itself.

    Raises:
        Unfused: a part without kernels that torch cannot take over either.
    """

    def __init__(self, model: Model, state: ClothState, drives: Mapping[str, Drive]) -> None:
        self.model = model
        self._left = running.BUDGET  # bytes of records that the adjoint may find ready
        low, parts = fitted(model, state, cut(drives, 0, 1))
        self.outside = Outside(model, parts) if parts else None
        self._known = {_pattern(drives): low}
        self._coefficients: dict[int, dict[Field, Tensor]] = {}  # by the program's number

    def rollout(
        self,
        state: ClothState,
        dt: float,
        drives: Mapping[str, Drive],
        substeps: int,
        first: int = 0,
        checkpoint: bool = True,
    ) -> tuple[ClothState, Impulses]:
        """As ``functional.rollout``. ``checkpoint``: the adjoint keeps to a budget of memory, and recomputes beyond."""
        total: Impulses = {}
        for begin, end in spans(drives, first, first + substeps, substeps if self.outside is None else CHUNK):
            state, impulses = self._span(state, dt, cut(drives, begin, end), end - begin, checkpoint)
            total = _sum(total, impulses)
        return state, total

    def lowering(self, state: ClothState, drives: Mapping[str, Drive]) -> Lowering:
        """The program for these grasps, closed or open, with the numbers of the model."""
        pattern = _pattern(drives)
        if pattern not in self._known:
            self._known[pattern], _ = fitted(self.model, state, cut(drives, 0, 1))
        return self._known[pattern]

    def coefficients(self, low: Lowering, dt: float, batch: torch.Size) -> dict[Field, Tensor]:
        """Inputs that stay the same over the substeps of a call."""
        number, step = low.program.number, torch.full((1, 1, 1), dt, dtype=low.program.dtype)
        if number not in self._coefficients:
            self._coefficients[number] = binding.flat(low, low.inputs, batch)
        return self._coefficients[number] | {low.dt: step}

    def _span(self, state: ClothState, dt: float, drives: Mapping[str, Drive], count: int, checkpoint: bool):
        """Substeps while no grasp opens or closes."""
        low, batch = self.lowering(state, drives), state.x.shape[:-2]
        fixed, moves = self.coefficients(low, dt, batch), binding.flat(low, binding.moves(low, drives), batch)
        outside = self.outside
        if outside is None:
            return self._call(low, state, fixed | moves, count, checkpoint)

        def run(state: ClothState) -> tuple[ClothState, Impulses]:
            total: Impulses = {}
            for k in range(count):
                force, memory = outside.force(state, dt)
                now = {field: rows[:, k : k + 1] for field, rows in moves.items()}
                state, impulses = self._call(low, state, fixed | now, 1, False, force)
                state = state._replace(memory=state.memory | memory)
                total = _sum(total, impulses)
            return state, total

        if checkpoint and torch.is_grad_enabled():
            return recompute(run, state, use_reentrant=False, preserve_rng_state=False)
        return run(state)

    def _call(
        self,
        low: Lowering,
        state: ClothState,
        others: dict[Field, Tensor],
        substeps: int,
        checkpoint: bool,
        force: Tensor | None = None,
    ) -> tuple[ClothState, Impulses]:
        batch, program = state.x.shape[:-2], low.program
        begin = binding.states(low, state)
        if low.given is not None and force is not None:
            begin[low.given] = force
        by_field = binding.flat(low, begin, batch) | others
        inputs = [by_field[field] for field in program.inputs]
        every = self._every(low, batch.numel(), substeps, checkpoint) if _needs_gradient(inputs) else 0
        *results, _ = Rollout.apply(program.number, substeps, every, *inputs)  # type: ignore[misc]
        return binding.outcome(low, state, dict(zip(program.outputs, results, strict=True)), batch)

    def _every(self, low: Lowering, scenes: int, substeps: int, checkpoint: bool) -> int:
        """Substeps between records: all while the budget lasts; 0: the adjoint makes its own when it comes here."""
        if not checkpoint:
            return 1
        size = running.full_size(low.program, scenes, substeps)
        if size > self._left:
            return 0
        self._left -= size
        return 1


def rollout(model: Model, state: ClothState, dt: float, drives: Mapping[str, Drive], substeps: int):
    """As ``functional.rollout``, from substep 0 of the drives.

    Raises:
        Unfused: a part without kernels.
    """
    return Fused(model, state, drives).rollout(state, dt, drives, substeps)


def spans(drives: Mapping[str, Drive], first: int, last: int, longest: int) -> Iterator[tuple[int, int]]:
    """(first, last) of pieces in which no grasp opens or closes, at most ``longest`` substeps each."""
    for _, group in groupby(range(first, last), lambda k: tuple(drive.closed[k] for drive in drives.values())):
        steps = list(group)
        for begin in range(steps[0], steps[-1] + 1, longest):
            yield begin, min(begin + longest, steps[-1] + 1)


def cut(drives: Mapping[str, Drive], first: int, last: int) -> dict[str, Drive]:
    """The drives of some substeps."""
    return {
        name: Drive(d.increment[..., first:last, :, :], d.pose[..., first:last, :, :], d.closed[first:last])
        for name, d in drives.items()
    }


def _pattern(drives: Mapping[str, Drive]) -> tuple[bool, ...]:
    return tuple(drive.closed[0] for drive in drives.values())


def _needs_gradient(inputs: list[Tensor]) -> bool:
    return torch.is_grad_enabled() and any(t.requires_grad for t in inputs)


def _sum(total: Impulses, more: Impulses) -> Impulses:
    return {name: total[name] + value if name in total else value for name, value in more.items()}
