"""Loops that several parts write into: over the triangles, the bent sheet, and the vertices' velocities."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from ..effects._bent import BentSheet
from .fields import Field
from .loops import Loop
from .stages import Shape

if TYPE_CHECKING:
    from .lowering import Lowering

LANES = 16  # of the widest pack, csrc/pack.h
TOGETHER = 16  # packs


class Triangles:
    """A loop over triangles; what several parts need is computed once.

    Args:
        lowering: the program.
        velocity: [V, 3], of the vertices; None: the cloth's.
        force: [V, 3], to be added to; None: the force on the cloth.
    """

    def __init__(self, lowering: Lowering, velocity: Field | None = None, force: Field | None = None) -> None:
        self._lowering = lowering
        self._velocity = lowering.v.now if velocity is None else velocity
        self._force = lowering.force if force is None else force
        g = lowering.model.geometry
        self.loop = lowering.program.loop(lowering.faces, scattered(lowering.faces))
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
        """The corners' positions; in float32 from the first one, as ``model.surface`` sees them."""
        low = self._lowering
        here = self._corners("x", low.x.now)
        if low.lost is None:
            return here
        lost = self._corners("lost", low.lost.now)
        both = self._once("edges", lambda: self.loop.call("edges", *here, *lost))
        return [self.loop.load(low.program.constant(np.zeros((1, 3)))), both[:3], both[3:]]

    @property
    def v(self) -> list[list[int]]:
        """The corners' velocities."""
        return self._corners("v", self._velocity)

    @property
    def surface(self) -> list[int]:
        """f1, f2, cofactor1, cofactor2, n, J: 16 registers."""
        return self._once("surface", lambda: self.loop.call("surface", *self.x, self.shape))

    @property
    def normal(self) -> list[int]:
        """Unit normal."""
        return self.surface[12:15]

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
                self.loop.add(self._forces[3 * k : 3 * k + 3], self._force, corner)

    def _corners(self, name: str, field: Field) -> list[list[int]]:
        flat = self._once(name, lambda: [r for c in self._lowering.corners for r in self.loop.load(field, c)])
        return [flat[0:3], flat[3:6], flat[6:9]]

    def _once(self, name: str, make) -> list[int]:
        if name not in self._done:
            self._done[name] = make()
        return self._done[name]


class Sheet:
    """The loop over vertices in which bending is seen, and moments become forces. effects/_bent.py"""

    def __init__(self, lowering: Lowering, bent: BentSheet, weight: Field) -> None:
        program, near = lowering.program, bent.near.cpu().numpy()
        seen = program.temporary(lowering.vertices, 15)
        self._answer = program.temporary(lowering.vertices, 15, kept=False)
        program.stencil(near, weight, lowering.x.now, seen)
        if lowering.lost is not None and any(key.startswith("effects.") for key in lowering.memory):
            program.stencil(near, weight, lowering.lost.now, seen)  # what remembers a path, adds up what is rounded
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


class Velocities:
    """The vertices' velocities on their way from the forces to the drift: registers, as long as one loop will do.

    Attributes:
        loop: over the vertices, where they are in registers.
        now: registers of the velocities in it.
        before: registers of what they were before the present boundary.
        field: where they are otherwise, for what changes few of them.
    """

    def __init__(self, low: Lowering, loop: Loop, now: list[int]) -> None:
        self._low, self.loop, self.now, self.before = low, loop, now, now
        self.field: Field | None = None
        self._drifted = False

    def store(self) -> Field:
        """End the loop; returns the velocities, for what is not done vertex by vertex. ``resume`` when it is done."""
        field = self._put(self.now)
        self._stored = field if self.before == self.now else self._put(self.before)
        return field

    def resume(self, field: Field) -> None:
        """A new loop, with the velocities of a field."""
        self.loop = self._low.loop(self._low.vertices)
        self.now, self.before = self.loop.load(field), self.loop.load(self._stored)

    def leave(self, drift: bool) -> Field:
        """Put all into ``field``; ``drift``: there they stay, so that the positions can follow at once."""
        if self.field is None and drift:
            self.drift()
            self.field = self._low.v.after
        elif self.field is None:
            self.before = self.now
            self.field = self.store()
        return self.field

    def enter(self) -> None:
        """Back into registers."""
        if self.field is not None:
            self.resume(self.field)
            self.field = None

    def overwrite(self, loop: Loop, rows: int, now: list[int]) -> None:
        """Other velocities for some rows of ``field``, from a loop over these."""
        if self.field is None:
            raise ValueError("the velocities are in registers")
        loop.put(now, self.field, rows)
        if self._drifted:
            self._follow(loop, now, rows)

    def drift(self) -> None:
        """Positions follow, once."""
        if not self._drifted:
            self.enter()
            self.loop.put(self.now, self._low.v.after)
            self._follow(self.loop, self.now)
            self._drifted = True

    def _follow(self, loop: Loop, now: list[int], rows: int | None = None) -> None:
        low = self._low
        numbers = loop.load(low.dt), loop.load(low.x.now, rows), now
        if low.lost is None:
            loop.put(loop.call("drift", *numbers), low.x.after, rows)
            return
        both = loop.call("drift_on", *numbers, loop.load(low.lost.now, rows))
        loop.put(both[:3], low.x.after, rows)
        loop.put(both[3:], low.lost.after, rows)

    def _put(self, regs: list[int]) -> Field:
        field = self._low.program.temporary(self._low.vertices, 3)
        self.loop.put(regs, field)
        return field


def scattered(items: int) -> np.ndarray:
    """An order in packs whose items are far apart in the mesh: additions to one vertex need not wait for each other.

    Packs that follow each other are near each other, for the cache, and for threads that have some of them each.
    """
    packs = -(-items // LANES)
    groups = np.array_split(np.arange(packs * LANES).reshape(packs, LANES), -(-packs // TOGETHER))
    order = np.concatenate([group.reshape(LANES, -1).T.ravel() for group in groups])
    return order[order < items]
