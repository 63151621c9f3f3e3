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
from ..effects._bent import BentSheet
from ..model import Model
from ..types import ClothState
from .outside import MATERIAL, obstacle
from .program import Field, Loop, Program, Shape
from .wrapped import array, is_wrapped, numbers_of_wrapped

LANES = 16  # of the widest pack, csrc/pack.h


DIRECTORS = "d3"  # key of the state's directors among the internal variables, where there is contact


class Unfused(Exception):
    """A part that the engine does not know; the text names it. ``part``: "material" or "effects.NAME"."""

    part: str | None = None


class State(NamedTuple):
    """A field at the start of the substep, and where it goes."""

    now: Field
    after: Field


class Motion(NamedTuple):
    """Fields of a drive, one row for every substep."""

    increment: Field  # [16]
    pose: Field  # [16]
    closed: Field  # [1], 0 or 1


class Lowering:
    """A program under construction, and the tensors that it will be run on.

    Attributes:
        model: the parts.
        program: what is built.
        x, v: positions and velocities.
        memory: internal variables by key, as in ``ClothState.memory``.
        force: [V, 3], to be added to.
        resistance: [V, 6] kg, mass of the air that moves along (xx, xy, xz, yy, yz, zz), to be added to; None without.
        triangles: the loop over triangles that comes first; ``Triangles`` has what is computed there already.
        sheets: how the sheet is bent at its vertices, by the weights of the derivatives.
        inputs: parameter fields with their tensors [..., rows, comps].
        given: a parameter field without tensor, for the forces of parts that torch computes; None: there are none.
        drives: by boundary.
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
        kept = {key: value for key, value in remembered(model, state).items() if key not in outside}
        self.memory = {key: State(*self.program.state(*value.shape[-2:])) for key, value in kept.items()}
        self.dt = self.program.parameter(1, 1)
        self.mass = self.parameter(model.mass)
        self.force = self.program.temporary(self.vertices, 3)
        self.given = self._given() if outside else None
        self.resistance: Field | None = None
        order = _scattered(self.faces)
        self.corners = [self.program.table(c[order]) for c in array(model.geometry.corners).reshape(3, -1)]
        self.triangles = Triangles(self, order)
        self.sheets: dict[Field, Sheet] = {}
        drive = self.program.drive
        self.drives = {name: Motion(drive(16), drive(16), drive(1)) for name in drives}
        self.impulses = {name: self.program.sum(6) for name in drives}

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

    def number(self, value: float) -> Field:
        """A constant of a part."""
        return self.program.constant(np.array([[value]]))

    def loop(self, items: int) -> Loop:
        """A loop after all that are there."""
        return self.program.loop(items)

    def sheet(self, bent: BentSheet) -> Sheet:
        """The one of these stencils, for all effects that see the same bending."""
        weight = self.program.constant(bent.weight.reshape(-1, 1), near=len(bent.near))
        if weight not in self.sheets:
            self.sheets[weight] = Sheet(self, bent, weight)
        return self.sheets[weight]

    def close(self) -> None:
        """No more forces."""
        self.triangles.close()
        for sheet in self.sheets.values():
            sheet.close()

    def resisted(self, loop: Loop, change: list[int], at: int | None = None) -> list[int]:
        """Registers of a change of velocity in the air that moves along, of all vertices or those of a table."""
        if self.resistance is None:
            return change
        return loop.call("resisted", loop.load(self.resistance, at), loop.load(self.mass, at), change)

    def momentum(self, loop: Loop, change: list[int], at: int | None = None) -> list[int]:
        """Registers of the momentum that a change of velocity takes, that of the air included."""
        mass = loop.load(self.mass, at)
        if self.resistance is None:
            return loop.call("scaled3", mass, change)
        return loop.call("loaded", loop.load(self.resistance, at), mass, change)


def remembered(model: Model, state: ClothState) -> dict[str, Tensor]:
    """Internal variables, and the directors where there is contact."""
    return dict(state.memory) if model.grid is None else {**state.memory, DIRECTORS: state.d3}


class Velocities:
    """The vertices' velocities on their way from the forces to the drift: registers, as long as one loop will do.

    Attributes:
        loop: over the vertices, the last of the program.
        now: registers of the velocities in it.
        before: registers of what they were before the present boundary.
    """

    def __init__(self, low: Lowering, loop: Loop, now: list[int]) -> None:
        self._low, self.loop, self.now, self.before = low, loop, now, now

    def store(self) -> Field:
        """End the loop; returns the velocities, for what is not done vertex by vertex. ``resume`` when it is done."""
        field = self._put(self.now)
        self._stored = field if self.before == self.now else self._put(self.before)
        return field

    def resume(self, field: Field) -> None:
        """A new loop, with the velocities of a field."""
        self.loop = self._low.loop(self._low.vertices)
        self.now, self.before = self.loop.load(field), self.loop.load(self._stored)

    def _put(self, regs: list[int]) -> Field:
        field = self._low.program.temporary(self._low.vertices, 3)
        self.loop.put(regs, field)
        return field


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
        self._forces: list[int] | None = None

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

    def push(self, kernel: str, *inputs: list[int]) -> None:
        """Forces on the corners (9 numbers) that a kernel gives."""
        self._forces = self.loop.call(kernel, *inputs, into=self._forces)

    def stress(self, columns: list[int]) -> None:
        """Forces of first Piola-Kirchhoff columns (6 registers) on the corners."""
        self.push("assemble", columns, self.shape, self.area)

    def close(self) -> None:
        """Give the corners the sum of all that acts: one scatter, however many effects there are."""
        if self._forces is not None:
            for k, corner in enumerate(self._lowering.corners):
                self.loop.add(self._forces[3 * k : 3 * k + 3], self._lowering.force, corner)

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


class Sheet:
    """The loop over vertices in which bending is seen, and moments become forces. effects/_bent.py"""

    def __init__(self, lowering: Lowering, bent: BentSheet, weight: Field) -> None:
        program, near = lowering.program, bent.near.cpu().numpy()
        seen = program.temporary(lowering.vertices, 15)
        self._answer = program.temporary(lowering.vertices, 15, kept=False)
        program.stencil(near, weight, lowering.x.now, seen)
        self.loop = lowering.loop(lowering.vertices)
        program.stencil(near, weight, lowering.force, self._answer, Shape.TRANSPOSED)
        self._seen = self.loop.load(seen)
        self._area = self.loop.load(program.constant(bent.area))
        self.second = [*self._seen[:9], *self._area]
        self._moment: list[int] | None = None
        self._stress: list[int] | None = None
        self._shape: list[int] = []

    @property
    def curvature(self) -> list[int]:
        """Along the normal."""
        if not self._shape:
            self._shape = self.loop.call("bent_sheet", self._seen)
        return self._shape[4:]

    def moment(self, moment: list[int]) -> None:
        """A bending moment (3 registers) that works on the curvature."""
        self._moment = moment if self._moment is None else self.loop.call("copy3", moment, into=self._moment)

    def stress(self, stress: list[int]) -> None:
        """What works on the derivatives (15 registers), times the area."""
        self._stress = stress if self._stress is None else self.loop.call("copy15", stress, into=self._stress)

    def close(self) -> None:
        """Give the sum of all to the stencils."""
        if self._moment is not None:
            _ = self.curvature
            self.stress(self.loop.call("bending_stress", self._seen, self._shape[:4], self._area, self._moment))
        if self._stress is not None:
            self.loop.put(self._stress, self._answer)


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
    from .parts.contact import Contact

    if model.transfer != "mesh":
        raise Unfused(f"transfer {model.transfer!r}")
    for key in state.memory:
        if key not in ("material", "contact") and key.removeprefix("effects.") not in model.effects:
            raise Unfused(f"memory {key!r} that no part owns")
    low = Lowering(model, state, drives, outside)
    if MATERIAL not in outside:
        _part(MATERIAL, lambda: materials.lower(low))
    for name, (effect, c) in model.effects.items():
        if f"effects.{name}" not in outside:
            _part(f"effects.{name}", lambda own=(name, effect, c): effects.lower(low, *own))
    low.close()
    contact = None if model.grid is None else Contact(low, model.grid)
    if contact is not None:
        contact.press()
    velocity = _kick(low)
    for name, boundary in model.boundaries.items():
        boundaries.lower(low, name, boundary, velocity)
    _drift(low, velocity)
    if contact is not None:
        contact.follow()
    low.program = low.program.ready()
    return low


def _part(name: str, lower: Callable[[], None]) -> None:
    try:
        lower()
    except Unfused as miss:
        miss.part = name
        raise


def _kick(low: Lowering) -> Velocities:
    loop = low.loop(low.vertices)
    dt, v, force, mass = (loop.load(field) for field in (low.dt, low.v.now, low.force, low.mass))
    if low.resistance is None:
        return Velocities(low, loop, loop.call("kick", dt, v, force, mass))
    return Velocities(low, loop, loop.call("kick_in_air", dt, v, force, mass, loop.load(low.resistance)))


def _drift(low: Lowering, velocity: Velocities) -> None:
    loop, v = velocity.loop, velocity.now
    loop.put(v, low.v.after)
    loop.put(loop.call("drift", loop.load(low.dt), loop.load(low.x.now), v), low.x.after)
