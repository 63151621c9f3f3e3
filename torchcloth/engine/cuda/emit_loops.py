"""Loops over triangles, vertices or points as CUDA C++: a function for values, and one for adjoints."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from ..enums import CONTACT_ROWS, ITEM_ROW, SINGLE_ROW, TRANSFER_SHARES, FieldKind, Opcode, TransferBasis
from ..loops import LOOKUP_REGISTERS
from .emit_contact import POINT_ROW_NUMBERS
from .kernel_codegen import kernel
from .layout import Layout
from .program_ir import TRIANGLE_CORNERS, Call, Lookup, Loop, Move, Transfer

ACTIVE_CONDITIONS = ("h.some", "h.activated", "(h.step == h.all - 1)")  # by ``ContactCount``: whether a loop has items
POINT_CONDITIONS = ("h.mask[t]", "h.mask[t] && !h.before[t]", "!h.mask[t]")  # whether it runs on triangle t's points


class LoopEmitter:
    """Functions of a loop.

    Args:
        layout: memory of the program.
        stage: the loop.
        first_written: fields that no earlier stage writes.
    """

    def __init__(self, layout: Layout, stage: Loop, first_written: set[int]) -> None:
        self._layout, self._stage, self._first_written = layout, stage, first_written
        self._fields = layout.fields
        # where the rows of contact points begin in scratch memory, forward (ADD) and back (LOAD)
        self._point_rows: dict[int, int] = {}

    def forward(self) -> Iterator[str]:
        """Yield the lines for values."""
        sums = [(m, c) for m in self._stage.moves(Opcode.ADD) if m.table == SINGLE_ROW for c in range(self._comps(m))]
        shared = {(m.field, c): f"s{k}" for k, (m, c) in enumerate(sums)}
        scratch = self._scratch_places(Opcode.ADD)
        yield from self._prologue("f", scratch, shared)
        for n, i in enumerate(self._stage.code):
            if isinstance(i, Transfer) and i.code == Opcode.P2G:
                yield from self._store_point_row(i, [f"r{i.shares + k}" for k in range(TRANSFER_SHARES)], Opcode.ADD)
                continue
            if not isinstance(i, Move):
                yield from self._value_lines(n, i)
                continue
            for c in range(self._comps(i)):
                place, reg = f"f{i.field}[{self._element(i, c)}]", f"r{i.reg + c}"
                if i.code == Opcode.LOAD:
                    yield f"    R {reg} = {place};"
                elif i.code == Opcode.STORE:
                    yield f"    {place} = {reg};"
                elif i.table == SINGLE_ROW:
                    yield f"    {shared[i.field, c]} += {reg};"
                elif i in scratch:
                    yield f"    {self._slot(scratch[i], c)} = {reg};"
                else:
                    fills = i.table == ITEM_ROW and self._stage.items == self._fields[i.field].rows
                    yield f"    {place} {'=' if fills and i.field in self._first_written else '+='} {reg};"
        yield "}"
        yield "SYNC();"
        for field, moves in self._by_field(scratch).items():
            fills = field in self._first_written and self._layout.fills(self._stage, field)
            yield from self._gather(f"f{field}", moves, scratch, "=" if fills else "+=")
        for i in self._stage.transfers(Opcode.P2G):
            begins = str(i.field in self._first_written).lower()
            rows = self._point_rows[Opcode.ADD]
            yield f"p2g(h.nodes, {_uses_arms(i)}, scratch + {rows}, h.f{i.field}, {begins});"
        if shared:
            yield from self._reduce([(f"h.f{field}[{c}]", name) for (field, c), name in shared.items()])

    def reverse(self) -> Iterator[str]:
        """Yield the lines for adjoints."""
        if self._stage.no_derivative:
            return
        scratch = self._scratch_places(Opcode.LOAD)
        loads = [m for m in self._stage.moves(Opcode.LOAD) if self._has_adjoint(m) and m.table == SINGLE_ROW]
        shared = {(m.field, c): f"s{k}_{c}" for k, m in enumerate(loads) for c in range(self._comps(m))}
        yield from self._prologue("fg", scratch, shared)
        for n, i in enumerate(self._stage.code):
            if isinstance(i, Transfer) and i.code == Opcode.P2G:
                continue
            if not isinstance(i, Move):
                yield from self._value_lines(n, i)
            elif i.code == Opcode.LOAD:
                for c in range(self._comps(i)):
                    yield f"    R r{i.reg + c} = f{i.field}[{self._element(i, c)}];"
        registers = sorted(self._all_registers())
        yield f"    R {', '.join(f'b{reg} = R(0)' for reg in registers)};"
        for n in reversed(range(len(self._stage.code))):
            i = self._stage.code[n]
            if isinstance(i, Move):
                yield from self._reverse_move(i, scratch, shared)
            elif isinstance(i, Call):
                seeds = [f"b{reg if reg >= 0 else ~reg}" for reg in i.outputs]
                inputs = [f"b{reg}" for reg in i.inputs]
                yield from (f"    {line}" for line in kernel(i.kernel).adjoints(f"n{n}_", seeds, inputs))
            elif isinstance(i, Transfer):
                yield from self._reverse_transfer(n, i)
            else:
                for k in range(3):
                    yield f"    b{i.place + k} += b{i.out + k};"
        yield "}"
        yield "SYNC();"
        for field, moves in self._by_field(scratch).items():
            yield from self._if_wanted(field, self._gather(f"g{field}", moves, scratch, "+="))
        for i in self._stage.transfers(Opcode.G2P):
            rows = self._point_rows[Opcode.LOAD]
            yield f"p2g(h.nodes, {_uses_arms(i)}, scratch + {rows}, h.g{i.field}, false);"
        for field in {field: None for field, _ in shared}:
            sums = [(c, name) for (f, c), name in shared.items() if f == field]
            if self._fields[field].kind == FieldKind.PARAMETER:  # until the end
                yield from (f"h.sums[{self._layout.accumulated[field, c]}] += {name};" for c, name in sums)
            else:
                yield from self._if_wanted(field, self._reduce([(f"g{field}[{c}]", name) for c, name in sums]))

    # -- parts of the above -------------------------------------------------------------------------------------------

    def _comps(self, move: Move) -> int:
        return self._fields[move.field].comps

    def _has_adjoint(self, move: Move) -> bool:
        return move.field in self._layout.with_adjoint

    def _prologue(self, letters: str, scratch: dict[Move, int], shared: dict[tuple[int, int], str]) -> Iterator[str]:
        """All lines before the instructions on an item."""
        for letter in letters:
            yield from self._pointers(letter)
        if shared:
            yield f"R {', '.join(f'{name} = R(0)' for name in shared.values())};"
        yield from self._item_loop(scratch)

    def _slot(self, at: int, c: int) -> str:
        """An item's number in scratch memory."""
        return f"scratch[{at + c * self._stage.items} + i]"

    def _pointers(self, letter: str) -> Iterator[str]:
        """Pointers to the fields; return at once where contact has nothing to do."""
        if letter == "f" and self._stage.contact_count >= 0:
            yield f"if (!{ACTIVE_CONDITIONS[self._stage.contact_count]}) return;"
        read = {i.field for i in self._stage.code if not isinstance(i, Call)}
        for field in sorted(read):
            if letter == "f" or field in self._layout.with_adjoint:
                yield f"R* const {letter}{field} = h.{letter}{field};"
        if letter == "f":
            yield "R* const scratch = h.scratch;"

    def _item_loop(self, scratch: dict[Move, int]) -> Iterator[str]:
        """Begin of the loop; scratch memory of points that take no part is 0."""
        yield f"for (int i = T; i < {self._stage.items}; i += THREADS) {{"
        if self._stage.contact_count >= 0:
            yield "    const int t = i / EACH;"
            yield f"    if (!({POINT_CONDITIONS[self._stage.contact_count]})) {{"
            for m, at in scratch.items():
                yield "        " + " ".join(f"{self._slot(at, c)} = R(0);" for c in range(self._comps(m)))
            yield "        continue;"
            yield "    }"
            for k in range(TRIANGLE_CORNERS):
                yield f"    const int v{k} = h.tables[{self._layout.corner_table(k)} + t];"
            yield "    const int s = i % EACH;"
        moves = self._stage.moves(Opcode.LOAD, Opcode.ADD, Opcode.STORE)
        for table in sorted({m.table for m in moves if m.table >= 0}):
            yield f"    const int w{table} = h.tables[{self._layout.table(table)} + i];"

    def _element(self, move: Move, c: int) -> str:
        if move.table == SINGLE_ROW:
            return str(c)
        if move.table <= CONTACT_ROWS:
            row = ("v0", "v1", "v2", "t", "i", "s")[self._stage.contact_table(move.table)]
        else:
            row = "i" if move.table == ITEM_ROW else f"w{move.table}"
        return f"{row} * {self._comps(move)} + {c}"

    def _value_lines(self, n: int, i: Call | Lookup | Transfer) -> Iterator[str]:
        """Values of instruction ``n``."""
        if isinstance(i, Transfer):
            return self._g2p(n, i)
        return self._call(n, i) if isinstance(i, Call) else self._lookup(n, i)

    def _g2p(self, n: int, i: Transfer) -> Iterator[str]:
        yield f"    R c{n}[{TRANSFER_SHARES}];"
        yield f"    for (int k = 0; k < {TRANSFER_SHARES}; k++) c{n}[k] = R(0);"
        yield f"    const R o{n}[3] = {{{self._offset(i)}}};"
        yield f"    g2p(h.nodes, i, {_uses_arms(i)}, o{n}, f{i.field}, c{n}, nullptr, nullptr);"
        for k in range(TRANSFER_SHARES):
            yield f"    R r{i.shares + k} = c{n}[{k}];"

    def _offset(self, i: Transfer) -> str:
        return ", ".join(f"r{i.offset + d}" for d in range(3))

    def _store_point_row(self, i: Transfer, shares: list[str], code: int) -> Iterator[str]:
        """Store what a point adds to the nodes in its row of scratch memory."""
        for k, value in enumerate([*shares, *(f"r{i.offset + d}" for d in range(3))]):
            yield f"    scratch[{self._point_rows[code]} + {POINT_ROW_NUMBERS} * i + {k}] = {value};"

    def _reverse_transfer(self, n: int, i: Transfer) -> Iterator[str]:
        letter = "r" if i.code == Opcode.P2G else "b"
        shares = [f"{letter}{i.shares + k}" for k in range(TRANSFER_SHARES)]
        yield "    {"
        yield f"        const R o[3] = {{{self._offset(i)}}}, work[{TRANSFER_SHARES}] = {{{', '.join(shares)}}};"
        yield f"        R c[{TRANSFER_SHARES}], turn[3] = {{R(0), R(0), R(0)}};"
        yield f"        for (int k = 0; k < {TRANSFER_SHARES}; k++) c[k] = R(0);"
        if i.code == Opcode.P2G:
            yield f"        g2p(h.nodes, i, {_uses_arms(i)}, o, g{i.field}, c, work, turn);"
            for k in range(TRANSFER_SHARES):
                yield f"        b{i.shares + k} += c[{k}];"
        else:
            yield f"        g2p(h.nodes, i, {_uses_arms(i)}, o, f{i.field}, nullptr, work, turn);"
        for d in range(3):
            yield f"        b{i.offset + d} += turn[{d}];"
        yield "    }"
        if i.code == Opcode.G2P:
            yield from self._store_point_row(i, shares, Opcode.LOAD)

    def _call(self, n: int, i: Call) -> Iterator[str]:
        listing = kernel(i.kernel)
        yield from (f"    {line}" for line in listing.values(f"n{n}_", [f"r{reg}" for reg in i.inputs]))
        for reg, out in zip(i.outputs, listing.out, strict=True):
            yield f"    R r{reg} = n{n}_{out};" if reg >= 0 else f"    r{~reg} += n{n}_{out};"

    def _lookup(self, n: int, i: Lookup) -> Iterator[str]:
        _, y, z = i.nodes
        for k in range(3):
            place = f"r{i.place + k}"
            last = f"R({i.nodes[k] - 2})"
            yield f"    const int n{n}_{k} = {place} > R(0) ? int({place} < {last} ? {place} : {last}) : 0;"
            yield f"    R r{i.out + k} = {place} - R(n{n}_{k});"
        for corner in range(8):
            at = f"((n{n}_0 + {corner >> 2}) * {y} + n{n}_1 + {corner >> 1 & 1}) * {z} + n{n}_2 + {corner & 1}"
            yield f"    R r{i.out + 3 + corner} = f{i.field}[{at}];"

    def _all_registers(self) -> set[int]:
        registers: set[int] = set()
        for i in self._stage.code:
            if isinstance(i, Move):
                registers |= {i.reg + c for c in range(self._comps(i))}
            elif isinstance(i, Transfer):
                registers |= {i.offset + d for d in range(3)} | {i.shares + k for k in range(TRANSFER_SHARES)}
            elif isinstance(i, Call):
                registers |= {*i.inputs, *(reg if reg >= 0 else ~reg for reg in i.outputs)}
            else:
                registers |= {i.place + k for k in range(3)} | {i.out + k for k in range(LOOKUP_REGISTERS)}
        return registers

    def _scratch_places(self, code: int) -> dict[Move, int]:
        """Moves to rows that other moves may access, with the places of their numbers in scratch memory."""
        moves = [m for m in self._stage.moves(code) if code == Opcode.ADD or self._has_adjoint(m)]
        scattered = [m for m in moves if m.table != SINGLE_ROW and not self._layout.is_direct(self._stage, m, code)]
        places, size = {}, 0
        for moves in self._by_field(scattered).values():  # the moves of a field lie next to each other
            for m in moves:
                places[m] = size
                size += self._comps(m) * self._stage.items
        self._point_rows[code] = size
        if self._stage.transfers(Opcode.P2G if code == Opcode.ADD else Opcode.G2P):
            size += POINT_ROW_NUMBERS * self._stage.items
        self._layout.reserve(scratch=size)
        return places

    @staticmethod
    def _by_field(moves: Iterable[Move]) -> dict[int, list[Move]]:
        grouped: dict[int, list[Move]] = {}
        for m in moves:
            grouped.setdefault(m.field, []).append(m)
        return grouped

    def _gather(self, target: str, moves: list[Move], scratch: dict[Move, int], assign: str) -> Iterator[str]:
        first, entries = self._layout.gather_tables(self._stage, moves)
        comps, n, base = self._comps(moves[0]), self._stage.items, scratch[moves[0]]
        yield f"for (int v = T; v < {self._fields[moves[0].field].rows}; v += THREADS) {{"
        yield f"    R {', '.join(f'a{c} = R(0)' for c in range(comps))};"
        yield f"    for (int e = h.tables[{first} + v]; e < h.tables[{first} + v + 1]; e++) {{"
        yield f"        const int at = {base} + h.tables[{entries} + e];"
        for c in range(comps):
            yield f"        a{c} += scratch[at + {c * n}];"
        yield "    }"
        for c in range(comps):
            yield f"    {target}[v * {comps} + {c}] {assign} a{c};"
        yield "}"
        yield "SYNC();"

    def _reduce(self, sums: list[tuple[str, str]]) -> Iterator[str]:
        self._layout.reserve(shared=len(sums))
        yield f"{{ const R numbers[{len(sums)}] = {{{', '.join(name for _, name in sums)}}};"
        yield f"  reduce(numbers, {len(sums)}, h.shared); }}"
        yield "if (T == 0) {"
        for k, (target, _) in enumerate(sums):
            yield f"    {target} += h.shared[{k}];"
        yield "}"
        yield "SYNC();"

    def _if_wanted(self, field: int, lines: Iterator[str]) -> Iterator[str]:
        """Guard the lines where nobody may want the gradient of an input."""
        if self._fields[field].kind not in (FieldKind.PARAMETER, FieldKind.PER_SUBSTEP):
            yield from lines
            return
        yield f"if (g{field}) {{"
        yield from (f"    {line}" for line in lines)
        yield "}"

    def _reverse_move(self, m: Move, scratch: dict[Move, int], shared: dict[tuple[int, int], str]) -> Iterator[str]:
        if not self._has_adjoint(m):
            return
        guard = (
            f"if (g{m.field}) " if self._fields[m.field].kind in (FieldKind.PARAMETER, FieldKind.PER_SUBSTEP) else ""
        )
        for c in range(self._comps(m)):
            place, bar = f"g{m.field}[{self._element(m, c)}]", f"b{m.reg + c}"
            if m.code != Opcode.LOAD:
                yield f"    {bar} += {place};"
                if m.code == Opcode.STORE:  # the earlier value was overwritten
                    yield f"    {place} = R(0);"
            elif m.table == SINGLE_ROW:
                yield f"    {shared[m.field, c]} += {bar};"
            elif m in scratch:
                yield f"    {guard}{self._slot(scratch[m], c)} = {bar};"
            else:
                yield f"    {guard}{place} += {bar};"


def _uses_arms(i: Transfer) -> str:
    return str(i.basis == TransferBasis.AFFINE).lower()
