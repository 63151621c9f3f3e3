"""Loops: the same few kernels on every item of a list, a triangle, a vertex or a contact point.

    loop = program.loop(triangles)
    x0, x1, x2 = (loop.load(x, at=corner) for corner in corners)
    *f, n, J = loop.call("surface", x0, x1, x2, ...)
    loop.add(force, into, at=corner)

A register is assigned once. A list of registers stands for a vector.
"""

from __future__ import annotations

from collections.abc import Sequence

from ..errors import InvalidInput
from .enums import ITEM_ROW, SINGLE_ROW, TRANSFER_SHARES, Opcode, TransferBasis
from .fields import Field
from .library import kernels
from .stages import RecordingApi

LOOKUP_REGISTERS = 11  # three fractions of a cell, and the values at its eight corners


class Loop:
    """Instructions that run on every item.

    Args:
        items: items of the loop; 0 where they are known at run time only.
        table_rows: rows that each table of the program needs.
        item_table: table that gives the row of each item.
        point_list: list of a broad phase on whose points it runs; -1: none.
        contact_count: which contact points it runs on, a ``ContactCount``; -1: none.
        no_derivative: results have no derivative.
        is_replayed: the reverse sweep runs it again, because it reads what the loop writes and nothing records.
    """

    def __init__(
        self,
        items: int,
        table_rows: Sequence[int],
        item_table: int = ITEM_ROW,
        point_list: int = -1,
        contact_count: int = -1,
        no_derivative: bool = False,
        is_replayed: bool = False,
    ) -> None:
        self.items, self._table_rows, self._item_table = items, table_rows, item_table
        self._point_list, self._contact_count = point_list, contact_count
        self.no_derivative, self.is_replayed = no_derivative, is_replayed
        self._registers = 0
        self._code: list[tuple] = []
        self._loaded: dict[tuple[int, int], list[int]] = {}

    def load(self, field: Field, at: int | None = None) -> list[int]:
        """Return registers with a row of the field: the item's row, the one in table ``at``, or the only one.

        A second call returns the same registers, because no loop reads what it writes.
        """
        table = self._table(field, at)
        if (field.id, table) not in self._loaded:
            regs = self._loaded[field.id, table] = self._allocate(field.comps)
            self._code.append(("move", int(Opcode.LOAD), field.id, table, regs[0]))
        return self._loaded[field.id, table]

    def call(self, kernel: str, *inputs: Sequence[int], into: list[int] | None = None) -> list[int]:
        """Return registers with the results of a kernel; ``into``: registers to which the results are added instead.

        Raises:
            ValueError: the kernel takes another count of numbers.
        """
        number, input_count, output_count = kernels()[kernel]
        flat = [reg for group in inputs for reg in group]
        if len(flat) != input_count:
            raise ValueError(f"kernel {kernel!r} takes {input_count} numbers, not {len(flat)}")
        out = self._allocate(output_count) if into is None else into
        self._code.append(("kernel", number, flat, out if into is None else [~reg for reg in out]))
        return out

    def lookup(self, table: Field, nodes: Sequence[int], place: Sequence[int]) -> tuple[list[int], list[int]]:
        """Return (fractions of the cell, values at its 8 corners) of a place in a grid.

        Args:
            table: values at the grid's nodes.
            nodes: nodes along x, y and z.
            place: registers with the place, in cells.
        """
        regs = self._allocate(LOOKUP_REGISTERS)
        self._code.append(("lookup", table.id, *nodes, place[0], regs[0]))
        return regs[:3], regs[3:]

    def add(self, regs: Sequence[int], field: Field, at: int | None = None) -> None:
        """Add registers to a row of the field."""
        self._move(Opcode.ADD, regs, field, at)

    def store(self, regs: Sequence[int], field: Field, at: int | None = None) -> None:
        """Write registers to a row of the field."""
        self._move(Opcode.STORE, regs, field, at)

    def p2g(self, offset: Sequence[int], shares: Sequence[int], field: Field, at: int, basis: TransferBasis) -> None:
        """Add a point's shares to the 27 grid nodes around it.

        Args:
            offset: registers of the point's offset from the lowest of these nodes, in grid spacings.
            shares: registers of its shares.
            field: of the nodes.
            at: table of the nodes around each point.
            basis: what the shares multiply.
        """
        self._code.append(("transfer", int(Opcode.P2G), field.id, at, offset[0], shares[0], int(basis)))

    def g2p(self, offset: Sequence[int], field: Field, at: int, basis: TransferBasis) -> list[int]:
        """Return registers of a point's shares, summed over the 27 grid nodes around it; arguments as for ``p2g``."""
        shares = self._allocate(TRANSFER_SHARES)
        self._code.append(("transfer", int(Opcode.G2P), field.id, at, offset[0], shares[0], int(basis)))
        return shares

    def _move(self, code: Opcode, regs: Sequence[int], field: Field, at: int | None) -> None:
        if len(regs) != field.comps or list(regs) != list(range(regs[0], regs[0] + len(regs))):
            raise ValueError(f"{field} cannot take the registers {regs}")
        self._code.append(("move", int(code), field.id, self._table(field, at), regs[0]))

    def _table(self, field: Field, at: int | None) -> int:
        if field.rows == 1:
            return SINGLE_ROW
        at = self._item_table if at is None else at
        if at == ITEM_ROW:
            needed, fits = self.items, field.rows == self.items
        elif at >= 0:
            needed, fits = self._table_rows[at], field.rows >= self._table_rows[at]
        else:  # rows that the contact search lists
            return at
        if field.rows and needed and not fits:  # beyond the rows lies other memory
            raise InvalidInput("coefficients", got=f"{field.rows} values", expected=f"1 or {needed}")
        return at

    def _allocate(self, count: int) -> list[int]:
        self._registers += count
        return list(range(self._registers - count, self._registers))

    def emit(self, handle: object, api: RecordingApi) -> None:
        """Append the loop, with its kernels and moves, to the program that the library builds."""
        needed = self._registers_of_reverse_sweep()
        counted = int(self._contact_count)
        api("loop")(handle, self.items, self._point_list, counted, int(self.no_derivative), int(self.is_replayed))
        for kind, *rest in self._code:
            if kind in ("move", "lookup"):
                api(kind)(handle, *rest)
            elif kind == "transfer":
                shares = rest[4]
                api("transfer")(handle, *rest, int(bool(needed & set(range(shares, shares + TRANSFER_SHARES)))))
            else:
                number, inputs, outputs = rest
                is_needed = int(any(reg in needed or ~reg in needed for reg in outputs))
                api("kernel")(handle, number, tuple(inputs), tuple(outputs), is_needed)

    def _registers_of_reverse_sweep(self) -> set[int]:
        """Registers whose values the reverse sweep reads."""
        needed: set[int] = set()
        for kind, *rest in self._code:
            if kind == "kernel":
                needed.update(rest[1])
            elif kind == "lookup":
                needed.update(range(rest[4], rest[4] + 3))
            elif kind == "transfer":
                code, _, _, offset, shares, _ = rest
                needed.update(range(offset, offset + 3))
                needed.update(range(shares, shares + TRANSFER_SHARES) if code == Opcode.P2G else ())
        return needed
