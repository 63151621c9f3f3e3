"""Loops: the same few kernels on every item of a list, a triangle, a vertex or a point of contact.

    loop = program.loop(triangles)
    x0, x1, x2 = (loop.load(x, at=corner) for corner in corners)
    *f, n, J = loop.call("surface", x0, x1, x2, ...)
    loop.add(force, into, at=corner)

A loop's registers are numbered once and for all; a list of them stands for a vector.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum

from ..errors import InvalidInput
from .fields import Field
from .library import kernels

OWN, SHARED, VARYING = -1, -2, -3
LOAD, ADD, PUT, SPREAD, COLLECT = 0, 2, 3, 5, 6
SHARES = 16  # numbers of a point, see csrc/transfer.h


class By(IntEnum):
    """What nodes get from points, and points from nodes, besides by weight; as in csrc/transfer.h."""

    SLOPES, ARMS = range(2)


class Loop:
    """Instructions on every item."""

    def __init__(
        self,
        items: int,
        reach: Sequence[int],
        own: int = OWN,
        among: int = -1,
        counted: int = -1,
        flat: bool = False,
        again: bool = False,
    ) -> None:
        self.items, self._reach, self._own, self._among, self._counted = items, reach, own, among, counted
        self.flat, self.again = flat, again
        self._used = 0
        self._code: list[tuple] = []
        self._loaded: dict[tuple[int, int], list[int]] = {}

    def load(self, field: Field, at: int | None = None) -> list[int]:
        """Registers with a row of the field: the item's own, the one in table ``at``, or the only one.

        The same registers whenever asked again: no loop reads what it writes.
        """
        place = self._place(field, at)
        if (field.id, place) not in self._loaded:
            regs = self._loaded[field.id, place] = self._new(field.comps)
            self._code.append(("move", LOAD, field.id, place, regs[0]))
        return self._loaded[field.id, place]

    def call(self, kernel: str, *inputs: Sequence[int], into: list[int] | None = None) -> list[int]:
        """Registers with a kernel's results; ``into``: added to these."""
        number, takes, gives = kernels()[kernel]
        flat = [reg for group in inputs for reg in group]
        if len(flat) != takes:
            raise ValueError(f"kernel {kernel!r} takes {takes} numbers, not {len(flat)}")
        out = self._new(gives) if into is None else into
        self._code.append(("call", number, flat, out if into is None else [~reg for reg in out]))
        return out

    def lookup(self, table: Field, nodes: Sequence[int], place: Sequence[int]) -> tuple[list[int], list[int]]:
        """(fractions of the cell, values at its 8 corners) of a place on a grid [x, y, z] in cells."""
        regs = self._new(11)
        self._code.append(("lookup", table.id, *nodes, place[0], regs[0]))
        return regs[:3], regs[3:]

    def add(self, regs: Sequence[int], field: Field, at: int | None = None) -> None:
        """Add registers to a row of the field."""
        self._move(ADD, regs, field, at)

    def put(self, regs: Sequence[int], field: Field, at: int | None = None) -> None:
        """Write registers to a row of the field."""
        self._move(PUT, regs, field, at)

    def spread(self, offset: Sequence[int], share: Sequence[int], field: Field, at: int, by: By) -> None:
        """Add a point's shares to the 27 nodes around it (table ``at``), by its offset from the lowest of them."""
        self._code.append(("transfer", SPREAD, field.id, at, offset[0], share[0], int(by)))

    def collect(self, offset: Sequence[int], field: Field, at: int, by: By) -> list[int]:
        """Shares of a point that are the sums over its nodes."""
        share = self._new(SHARES)
        self._code.append(("transfer", COLLECT, field.id, at, offset[0], share[0], int(by)))
        return share

    def _move(self, code: int, regs: Sequence[int], field: Field, at: int | None) -> None:
        if len(regs) != field.comps or list(regs) != list(range(regs[0], regs[0] + len(regs))):
            raise ValueError(f"{field} cannot take the registers {regs}")
        self._code.append(("move", code, field.id, self._place(field, at), regs[0]))

    def _place(self, field: Field, at: int | None) -> int:
        if field.rows == 1:
            return SHARED
        at = self._own if at is None else at
        if at == OWN:
            wanted, fits = self.items, field.rows == self.items
        elif at >= 0:
            wanted, fits = self._reach[at], field.rows >= self._reach[at]
        else:  # what contact finds
            return at
        if field.rows and wanted and not fits:  # beyond the rows lies other memory
            raise InvalidInput("coefficients", got=f"{field.rows} values", expected=f"1 or {wanted}")
        return at

    def _new(self, count: int) -> list[int]:
        self._used += count
        return list(range(self._used - count, self._used))

    def emit(self, handle, api) -> None:
        """Write down the instructions."""
        read = self._read()
        api("loop")(handle, self.items, self._among, int(self._counted), int(self.flat), int(self.again))
        for kind, *rest in self._code:
            if kind in ("move", "lookup"):
                api(kind)(handle, *rest)
            elif kind == "transfer":
                share = rest[4]
                api("transfer")(handle, *rest, int(bool(read & set(range(share, share + SHARES)))))
            else:
                number, takes, gives = rest
                feeds = int(any(reg in read or ~reg in read for reg in gives))
                api("call")(handle, number, tuple(takes), tuple(gives), feeds)

    def _read(self) -> set[int]:
        """Registers whose values the reverse sweep needs."""
        read: set[int] = set()
        for kind, *rest in self._code:
            if kind == "call":
                read.update(rest[1])
            elif kind == "lookup":
                read.update(range(rest[4], rest[4] + 3))
            elif kind == "transfer":
                code, _, _, offset, share, _ = rest
                read.update(range(offset, offset + 3))
                read.update(range(share, share + SHARES) if code == SPREAD else ())
        return read
