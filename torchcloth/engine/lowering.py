"""A model turned into a program of the engine: the page ``functional.step`` in the engine's words.

The parts (materials, effects, boundaries) say in ``parts`` which kernels they are. Only exact types count: a subclass
may have changed its law. Materials and effects without kernels are left to torch, see ``torch_parts``.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..boundaries import Drive
from ..dynamics.elasticity import MATERIAL
from ..dynamics.model import Model
from ..effects._bent import BentSheet
from ..types import ClothState
from . import devices
from .constants import array
from .fields import Field
from .loops import Loop
from .program import Program
from .shared_loops import Sheet, Triangles, Velocities, scattered

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
        device: where the tensors are.
        x, v: positions and velocities.
        lost: in float32, what was too small to be added to the positions, see ``functional.stretch``; None in float64.
        memory: internal variables by key, as in ``ClothState.memory``.
        force: [V, 3], to be added to.
        pulls: kernels that give each vertex a force of its own, and the fields whose rows they take; see ``pull``.
        viscous: each adds the viscous force of velocities to a field, both [V, 3]; where the model has stages.
        resistance: [V, 6] kg, mass of the air that moves along (xx, xy, xz, yy, yz, zz), to be added to; None without.
        triangles: the loop over triangles that comes first; ``Triangles`` has what is computed there already.
        sheets: how the sheet is bent at its vertices, by the weights of the derivatives.
        inputs: parameter fields with their tensors [..., rows, comps].
        torch_force: a parameter field without tensor, for what the parts in torch give; None: there are none.
        drives: by boundary.
        impulses: by boundary, [6].
    """

    def __init__(
        self, model: Model, state: ClothState, drives: Mapping[str, Drive], in_torch: Collection[str] = ()
    ) -> None:
        self.model = model
        self.vertices, self.faces = state.x.shape[-2], len(model.geometry.area)
        self.device = state.x.device
        self.program = Program(state.x.dtype, self.vertices)
        self.inputs: dict[Field, Tensor] = {}
        self._known: dict[int, Field] = {}
        self.x, self.v = (State(*self.program.state(self.vertices, 3)) for _ in range(2))
        self.lost: State | None = None
        if state.x.dtype == torch.float32:
            self.lost = State(*self.program.state(self.vertices, 3))
            self.inputs[self.lost.now] = torch.zeros(self.vertices, 3, dtype=torch.float32, device=self.device)
        kept = {key: value for key, value in remembered(model, state).items() if key not in in_torch}
        self.memory = {key: State(*self.program.state(*value.shape[-2:])) for key, value in kept.items()}
        self.dt = self.program.drive(1)
        self.mass = self.parameter(model.mass)
        self.force = self.program.temporary(self.vertices, 3)
        self.pulls: list[tuple[str, tuple[Field, ...]]] = []
        self.viscous: list[Callable[[Field, Field], None]] = []
        self.torch_force = self._forces_from_torch() if in_torch else None
        self.resistance: Field | None = None
        order = scattered(self.faces)
        self.corners = [self.program.table(c[order]) for c in array(model.geometry.corners).reshape(3, -1)]
        self.triangles = Triangles(self)
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

    def pull(self, kernel: str, *fields: Field) -> None:
        """A force on every vertex, from the vertex's own row of these fields."""
        self.pulls.append((kernel, fields))

    def _forces_from_torch(self) -> Field:
        given = self.program.parameter(self.vertices, 3)
        self.pull("copy3", given)
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

    def momentum(self, loop: Loop, change: list[int], at: int | None = None) -> list[int]:
        """Registers of the momentum that a change of velocity takes, that of the air included."""
        mass = loop.load(self.mass, at)
        if self.resistance is None:
            return loop.call("scaled3", mass, change)
        return loop.call("loaded", loop.load(self.resistance, at), mass, change)

    def air_per_own(self, loop: Loop) -> list[int]:
        """Registers of the mass of the air that moves along with a vertex, over its own; none without."""
        if self.resistance is None:
            return []
        return loop.call("per_own", loop.load(self.resistance), loop.load(self.mass))


def remembered(model: Model, state: ClothState) -> dict[str, Tensor]:
    """Internal variables, and the directors where there is contact."""
    return dict(state.memory) if model.grid is None else {**state.memory, DIRECTORS: state.d3}


def lower(model: Model, state: ClothState, drives: Mapping[str, Drive], in_torch: Collection[str] = ()) -> Lowering:
    """The program of a substep without the parts ``in_torch``; from the drives only names and flags are taken.

    Raises:
        Unfused: a part without kernels.
    """
    from .lowerings import boundaries, effects, materials
    from .lowerings.contact import Contact

    if model.custom_substep is not None:
        raise Unfused(f"substep {model.custom_substep.name!r}")
    for key in state.memory:
        if key not in (MATERIAL, "contact") and key.removeprefix("effects.") not in model.effects:
            raise Unfused(f"memory {key!r} that no part owns")
    low = Lowering(model, state, drives, in_torch)
    if MATERIAL not in in_torch:
        _part(MATERIAL, lambda: materials.lower(low))
    for name, (effect, c) in model.effects.items():
        if f"effects.{name}" not in in_torch:
            _part(f"effects.{name}", lambda own=(name, effect, c): effects.lower(low, *own))
    low.close()
    contact = None if model.grid is None else Contact(low, model.grid)
    if contact is not None:
        contact.press()
    velocity = _kick(low)
    boundaries.lower(low, velocity)
    velocity.drift()
    if contact is not None:
        contact.follow()
    low.program = low.program.ready(keep=devices.elsewhere(state.x))
    return low


def _part(name: str, lower: Callable[[], None]) -> None:
    try:
        lower()
    except Unfused as miss:
        miss.part = name
        raise


def _kick(low: Lowering) -> Velocities:
    from .lowerings.viscous_stages import relaxed

    loop, v = relaxed(low)
    dt, force, mass = (loop.load(field) for field in (low.dt, low.force, low.mass))
    for kernel, fields in low.pulls:
        loop.call(kernel, *(loop.load(field) for field in fields), into=force)
    if low.resistance is None:
        return Velocities(low, loop, loop.call("kick", dt, v, force, mass))
    return Velocities(low, loop, loop.call("kick_in_air", dt, v, force, mass, loop.load(low.resistance)))
