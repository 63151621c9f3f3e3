"""A model turned into a program of the engine: the page ``functional.step`` in the engine's words.

The parts (materials, effects, boundaries) say in ``parts`` which kernels they are. Only exact types count: a subclass
may have changed its law. Materials and effects without kernels are left to torch, see ``outside``.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from contextlib import nullcontext
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..boundaries import Drive
from ..model import Model
from ..types import ClothState
from .outside import MATERIAL, obstacle
from .program import Field, Loop, Program
from .wrapped import array, is_wrapped, numbers_of_wrapped

LANES = 16  # of the widest pack, csrc/pack.h


class Unfused(Exception):
    """A part that the engine does not know; the text names it. ``part``: "material" or "effects.NAME"."""

    part: str | None = None


class State(NamedTuple):
    """A field at the start of the substep, and where it goes."""

    now: Field
    after: Field


class Lowering:
    """A program under construction, and the tensors that it will be run on.

    Attributes:
        model: the parts.
        program: what is built.
        x, v: positions and velocities.
        memory: internal variables by key, as in ``ClothState.memory``.
        force: [V, 3], to be added to.
        triangles: the loop over triangles that comes first; ``Triangles`` has what is computed there already.
        inputs: parameter fields with their tensors [..., rows, comps].
        given: a parameter field without tensor, for the forces of parts that torch computes; None: there are none.
        drives: by boundary, (increment, pose) fields [16] each.
        impulses: by boundary, [6].
    """

    def __init__(
        self, model: Model, state: ClothState, drives: Mapping[str, Drive], outside: Collection[str] = ()
    ) -> None:
        self.model = model
        self.vertices, self.faces = state.x.shape[-2], len(model.geometry.area)
        self.program = Program(state.x.dtype, self.vertices)
        self.inputs: dict[Field, Tensor] = {}
        self._known: dict[int, Field] = {}
        self.x, self.v = (State(*self.program.state(self.vertices, 3)) for _ in range(2))
        kept = {key: value for key, value in state.memory.items() if key not in outside}
        self.memory = {key: State(*self.program.state(*value.shape[-2:])) for key, value in kept.items()}
        self.dt = self.program.parameter(1, 1)
        self.mass = self.parameter(model.mass)
        self.force = self.program.temporary(self.vertices, 3)
        self.given = self._given() if outside else None
        self.resistance: Field | None = None
        order = _scattered(self.faces)
        self.corners = [self.program.table(c[order]) for c in array(model.geometry.corners).reshape(3, -1)]
        self.triangles = Triangles(self, order)
        self.drives = {name: (self.program.drive(16), self.program.drive(16)) for name in drives}
        self.impulses = {name: self.program.sum(6) for name in drives}
        self.closed = {name: drive.closed for name, drive in drives.items()}

    def parameter(self, tensor: Tensor, near: int = 0) -> Field:
        """The input field of a coefficient [..., rows, comps]; one tensor has one field. ``near``: of a stencil."""
        if id(tensor) not in self._known:
            field = self.program.parameter(tensor.shape[-2], tensor.shape[-1], near)
            self._known[id(tensor)], self.inputs[field] = field, tensor
        return self._known[id(tensor)]

    @property
    def carried(self) -> dict[str, State]:
        """All that goes on from substep to substep, by its name in the state."""
        return {"x": self.x, "v": self.v, **self.memory}

    def _given(self) -> Field:
        """Forces [V, 3] that torch computes, as an input."""
        given = self.program.parameter(self.vertices, 3)
        loop = self.loop(self.vertices)
        loop.add(loop.call("copy3", loop.load(given)), self.force)
        return given

    def loop(self, items: int) -> Loop:
        """A loop after all that are there."""
        return self.program.loop(items)


class Triangles:
    """The loop over triangles; what several parts need is computed once."""

    def __init__(self, lowering: Lowering, order: np.ndarray) -> None:
        self._lowering = lowering
        g = lowering.model.geometry
        self.loop = lowering.program.loop(lowering.faces, order)
        program = lowering.program
        self.shape = self.loop.load(program.constant(torch.cat([*g.warp, *g.weft], dim=-1)))  # a1, a2, b1, b2
        self.area = self.loop.load(program.constant(g.area))
        self._done: dict[str, list[int]] = {}

    def parameter(self, tensor: Tensor) -> list[int]:
        """Registers of a coefficient [..., E or 1, comps]."""
        return self._once(f"parameter {id(tensor)}", lambda: self.loop.load(self._lowering.parameter(tensor)))

    @property
    def x(self) -> list[list[int]]:
        """The corners' positions."""
        return self._corners("x", self._lowering.x.now)

    @property
    def v(self) -> list[list[int]]:
        """The corners' velocities."""
        return self._corners("v", self._lowering.v.now)

    @property
    def surface(self) -> list[int]:
        """f1, f2, cofactor1, cofactor2, n, J: 16 registers."""
        return self._once("surface", lambda: self.loop.call("surface", *self.x, self.shape))

    @property
    def normal(self) -> list[int]:
        """Unit normal."""
        return self.surface[12:15]

    @property
    def J(self) -> list[int]:
        """Area ratio."""
        return self.surface[15:]

    def stress(self, columns: list[int]) -> None:
        """Forces of first Piola-Kirchhoff columns (6 registers) on the corners."""
        self.forces(self.loop.call("assemble", columns, self.shape, self.area))

    def push(self, force: list[int]) -> None:
        """A force on the triangle, in equal parts on its corners."""
        self.forces(self.loop.call("thirds", force))

    def forces(self, regs: list[int]) -> None:
        """Forces on the three corners (9 registers)."""
        for k, corner in enumerate(self._lowering.corners):
            self.loop.add(regs[3 * k : 3 * k + 3], self._lowering.force, corner)

    def _corners(self, name: str, field: Field) -> list[list[int]]:
        flat = self._once(name, lambda: [r for c in self._lowering.corners for r in self.loop.load(field, c)])
        return [flat[0:3], flat[3:6], flat[6:9]]

    def _once(self, name: str, make) -> list[int]:
        if name not in self._done:
            self._done[name] = make()
        return self._done[name]


def _scattered(items: int) -> np.ndarray:
    """An order whose neighbours are far apart in the mesh: additions to one vertex need not wait for each other."""
    packs = -(-items // LANES)
    order = np.arange(packs * LANES).reshape(LANES, packs).T.ravel()
    return order[order < items]


def fitted(model: Model, state: ClothState, drives: Mapping[str, Drive]) -> tuple[Lowering, frozenset[str]]:
    """The program of a substep, and the parts that are left to torch.

    Raises:
        Unfused: a part without kernels that cannot be left to torch.
    """
    outside: set[str] = set()
    readable = numbers_of_wrapped() if is_wrapped(model.mass) else nullcontext()
    while True:
        try:
            with readable:
                return lower(model, state, drives, outside), frozenset(outside)
        except Unfused as miss:
            if miss.part is None:
                raise
            if reason := obstacle(model, miss.part):
                raise Unfused(f"{miss}, {reason},") from None
            outside.add(miss.part)


def lower(model: Model, state: ClothState, drives: Mapping[str, Drive], outside: Collection[str] = ()) -> Lowering:
    """The program of a substep without the parts ``outside``; from the drives only names and flags are taken.

    Raises:
        Unfused: a part without kernels.
    """
    from .parts import boundaries, effects, materials

    if model.transfer != "mesh":
        raise Unfused(f"transfer {model.transfer!r}")
    if model.grid is not None:
        raise Unfused("contact between layers")
    low = Lowering(model, state, drives, outside)
    if MATERIAL not in outside:
        _part(MATERIAL, lambda: materials.lower(low))
    for name, (effect, c) in model.effects.items():
        if f"effects.{name}" not in outside:
            _part(f"effects.{name}", lambda own=(name, effect, c): effects.lower(low, *own))
    velocity = _kick(low)
    for name, boundary in model.boundaries.items():
        velocity = boundaries.lower(low, name, boundary, velocity)
    _drift(low, velocity)
    low.program = low.program.ready()
    return low


def _part(name: str, lower: Callable[[], None]) -> None:
    try:
        lower()
    except Unfused as miss:
        miss.part = name
        raise


def _kick(low: Lowering) -> Field:
    free = low.program.temporary(low.vertices, 3)
    loop = low.loop(low.vertices)
    parts = [loop.load(field) for field in (low.dt, low.v.now, low.force, low.mass)]
    loop.put(loop.call("kick", *parts), free)
    return free


def _drift(low: Lowering, velocity: Field) -> None:
    loop = low.loop(low.vertices)
    dt, x, v = (loop.load(field) for field in (low.dt, low.x.now, velocity))
    loop.put(loop.call("copy3", v), low.v.after)
    loop.put(loop.call("drift", dt, x, v), low.x.after)
