"""Loops over triangles, vertices or points as CUDA C++: a function for values, and one for adjoints."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

from ..fields import Kind
from ..loops import ADD, COLLECT, LOAD, OWN, PUT, SHARED, SHARES, SPREAD, VARYING, By
from .emit_contact import ROW
from .kernel_codegen import kernel
from .program_ir import CORNERS, Call, Lookup, Loop, Move, Transfer

if TYPE_CHECKING:
    from .codegen import Source


class OfLoop:
    """Functions of a loop."""

    def __init__(self, source: Source, stage: Loop, begins: set[int]) -> None:
        self._source, self._stage, self._begins, self._fields = source, stage, begins, source.of.fields
        self._rows: dict[int, int] = {}  # where in scratch those of points begin, forward (ADD) and back (LOAD)

    def forward(self) -> Iterator[str]:
        """Values."""
        sums = [(m, c) for m in self._stage.moves(ADD) if m.table == SHARED for c in range(self._comps(m))]
        shared = {(m.field, c): f"s{k}" for k, (m, c) in enumerate(sums)}
        scratch = self._scratched(ADD)
        yield from self._begun("f", scratch, shared)
        for n, i in enumerate(self._stage.code):
            if isinstance(i, Transfer) and i.code == SPREAD:
                yield from self._given(i, [f"r{i.share + k}" for k in range(SHARES)], ADD)
                continue
            if not isinstance(i, Move):
                yield from self._computed(n, i)
                continue
            for c in range(self._comps(i)):
                place, reg = f"f{i.field}[{self._place(i, c)}]", f"r{i.reg + c}"
                if i.code == LOAD:
                    yield f"    R {reg} = {place};"
                elif i.code == PUT:
                    yield f"    {place} = {reg};"
                elif i.table == SHARED:
                    yield f"    {shared[i.field, c]} += {reg};"
                elif i in scratch:
                    yield f"    {self._slot(scratch[i], c)} = {reg};"
                else:
                    begins = (
                        i.field in self._begins and i.table == OWN and self._stage.items == self._fields[i.field].rows
                    )
                    yield f"    {place} {'=' if begins else '+='} {reg};"
        yield "}"
        yield "SYNC();"
        for field, moves in self._by_field(scratch).items():
            begins = "=" if field in self._begins and self._source.fills(self._stage, field) else "+="
            yield from self._gathered(f"f{field}", moves, scratch, begins)
        for i in self._stage.transfers(SPREAD):
            begins = str(i.field in self._begins).lower()
            yield f"gather(h.nodes, {_arms(i)}, scratch + {self._rows[ADD]}, h.f{i.field}, {begins});"
        if shared:
            yield from self._reduced([(f"h.f{field}[{c}]", name) for (field, c), name in shared.items()])

    def reverse(self) -> Iterator[str]:
        """Adjoints."""
        if self._stage.flat:
            return
        scratch = self._scratched(LOAD)
        loads = [m for m in self._stage.moves(LOAD) if self._is_active(m) and m.table == SHARED]
        shared = {(m.field, c): f"s{k}_{c}" for k, m in enumerate(loads) for c in range(self._comps(m))}
        yield from self._begun("fg", scratch, shared)
        for n, i in enumerate(self._stage.code):
            if isinstance(i, Transfer) and i.code == SPREAD:
                continue
            if not isinstance(i, Move):
                yield from self._computed(n, i)
            elif i.code == LOAD:
                for c in range(self._comps(i)):
                    yield f"    R r{i.reg + c} = f{i.field}[{self._place(i, c)}];"
        registers = sorted(self._registers())
        yield f"    R {', '.join(f'b{reg} = R(0)' for reg in registers)};"
        for n in reversed(range(len(self._stage.code))):
            i = self._stage.code[n]
            if isinstance(i, Move):
                yield from self._moved_back(i, scratch, shared)
            elif isinstance(i, Call):
                seeds = [f"b{reg if reg >= 0 else ~reg}" for reg in i.outputs]
                inputs = [f"b{reg}" for reg in i.inputs]
                yield from (f"    {line}" for line in kernel(i.kernel).adjoints(f"n{n}_", seeds, inputs))
            elif isinstance(i, Transfer):
                yield from self._transferred_back(n, i)
            else:
                for k in range(3):
                    yield f"    b{i.place + k} += b{i.out + k};"
        yield "}"
        yield "SYNC();"
        for field, moves in self._by_field(scratch).items():
            yield from self._if_wanted(field, self._gathered(f"g{field}", moves, scratch, "+="))
        for i in self._stage.transfers(COLLECT):
            yield f"gather(h.nodes, {_arms(i)}, scratch + {self._rows[LOAD]}, h.g{i.field}, false);"
        for field in {field: None for field, _ in shared}:
            own = [(c, name) for (f, c), name in shared.items() if f == field]
            if self._fields[field].kind == Kind.PARAMETER:  # until the end
                yield from (f"h.sums[{self._source.lasting[field, c]}] += {name};" for c, name in own)
            else:
                yield from self._if_wanted(field, self._reduced([(f"g{field}[{c}]", name) for c, name in own]))

    # -- parts of the above -------------------------------------------------------------------------------------------

    def _comps(self, move: Move) -> int:
        return self._fields[move.field].comps

    def _is_active(self, move: Move) -> bool:
        return move.field in self._source.active

    def _begun(self, letters: str, scratch: dict[Move, int], shared: dict[tuple[int, int], str]) -> Iterator[str]:
        """All before the instructions on an item."""
        for letter in letters:
            yield from self._pointers(letter)
        if shared:
            yield f"R {', '.join(f'{name} = R(0)' for name in shared.values())};"
        yield from self._items(scratch)

    def _slot(self, at: int, c: int) -> str:
        """An item's number in scratch."""
        return f"scratch[{at + c * self._stage.items} + i]"

    def _pointers(self, letter: str) -> Iterator[str]:
        """In registers; not where contact has nothing to do."""
        if letter == "f" and self._stage.counted >= 0:
            yield f"if (!{('h.some', 'h.woken', '(h.step == h.all - 1)')[self._stage.counted]}) return;"
        read = {i.field for i in self._stage.code if not isinstance(i, Call)}
        for field in sorted(read):
            if letter == "f" or field in self._source.active:
                yield f"R* const {letter}{field} = h.{letter}{field};"
        if letter == "f":
            yield "R* const scratch = h.scratch;"

    def _items(self, scratch: dict[Move, int]) -> Iterator[str]:
        """Their loop begins; of those that contact leaves out, nothing lies in ``scratch``."""
        yield f"for (int i = T; i < {self._stage.items}; i += THREADS) {{"
        if self._stage.counted >= 0:
            takes = ("h.mask[t]", "h.mask[t] && !h.before[t]", "!h.mask[t]")[self._stage.counted]
            yield "    const int t = i / EACH;"
            yield f"    if (!({takes})) {{"
            for m, at in scratch.items():
                yield "        " + " ".join(f"{self._slot(at, c)} = R(0);" for c in range(self._comps(m)))
            yield "        continue;"
            yield "    }"
            for k in range(CORNERS):
                yield f"    const int v{k} = h.tables[{self._source.corner(k)} + t];"
            yield "    const int s = i % EACH;"
        for table in sorted({m.table for m in self._stage.moves(LOAD, ADD, PUT) if m.table >= 0}):
            yield f"    const int w{table} = h.tables[{self._source.table(table)} + i];"

    def _place(self, move: Move, c: int) -> str:
        if move.table == SHARED:
            return str(c)
        if move.table <= VARYING:
            row = ("v0", "v1", "v2", "t", "i", "s")[self._stage.listed(move.table)]
        else:
            row = "i" if move.table == OWN else f"w{move.table}"
        return f"{row} * {self._comps(move)} + {c}"

    def _computed(self, n: int, i: Call | Lookup | Transfer) -> Iterator[str]:
        """Values of instruction ``n``."""
        if isinstance(i, Transfer):
            return self._collected(n, i)
        return self._called(n, i) if isinstance(i, Call) else self._looked_up(n, i)

    def _collected(self, n: int, i: Transfer) -> Iterator[str]:
        yield f"    R c{n}[{SHARES}];"
        yield f"    for (int k = 0; k < {SHARES}; k++) c{n}[k] = R(0);"
        yield f"    const R o{n}[3] = {{{self._offset(i)}}};"
        yield f"    look(h.nodes, i, {_arms(i)}, o{n}, f{i.field}, c{n}, nullptr, nullptr);"
        for k in range(SHARES):
            yield f"    R r{i.share + k} = c{n}[{k}];"

    def _offset(self, i: Transfer) -> str:
        return ", ".join(f"r{i.offset + d}" for d in range(3))

    def _given(self, i: Transfer, shares: list[str], code: int) -> Iterator[str]:
        """What a point gives to the nodes, in its row of scratch."""
        for k, value in enumerate([*shares, *(f"r{i.offset + d}" for d in range(3))]):
            yield f"    scratch[{self._rows[code]} + {ROW} * i + {k}] = {value};"

    def _transferred_back(self, n: int, i: Transfer) -> Iterator[str]:
        letter = "r" if i.code == SPREAD else "b"
        shares = [f"{letter}{i.share + k}" for k in range(SHARES)]
        yield "    {"
        yield f"        const R o[3] = {{{self._offset(i)}}}, given[{SHARES}] = {{{', '.join(shares)}}};"
        yield f"        R c[{SHARES}], turn[3] = {{R(0), R(0), R(0)}};"
        yield f"        for (int k = 0; k < {SHARES}; k++) c[k] = R(0);"
        if i.code == SPREAD:
            yield f"        look(h.nodes, i, {_arms(i)}, o, g{i.field}, c, given, turn);"
            for k in range(SHARES):
                yield f"        b{i.share + k} += c[{k}];"
        else:
            yield f"        look(h.nodes, i, {_arms(i)}, o, f{i.field}, nullptr, given, turn);"
        for d in range(3):
            yield f"        b{i.offset + d} += turn[{d}];"
        yield "    }"
        if i.code == COLLECT:
            yield from self._given(i, shares, LOAD)

    def _called(self, n: int, i: Call) -> Iterator[str]:
        found = kernel(i.kernel)
        yield from (f"    {line}" for line in found.values(f"n{n}_", [f"r{reg}" for reg in i.inputs]))
        for reg, out in zip(i.outputs, found.out, strict=True):
            yield f"    R r{reg} = n{n}_{out};" if reg >= 0 else f"    r{~reg} += n{n}_{out};"

    def _looked_up(self, n: int, i: Lookup) -> Iterator[str]:
        _, y, z = i.nodes
        for k in range(3):
            place = f"r{i.place + k}"
            most = f"R({i.nodes[k] - 2})"
            yield f"    const int n{n}_{k} = {place} > R(0) ? int({place} < {most} ? {place} : {most}) : 0;"
            yield f"    R r{i.out + k} = {place} - R(n{n}_{k});"
        for corner in range(8):
            at = f"((n{n}_0 + {corner >> 2}) * {y} + n{n}_1 + {corner >> 1 & 1}) * {z} + n{n}_2 + {corner & 1}"
            yield f"    R r{i.out + 3 + corner} = f{i.field}[{at}];"

    def _registers(self) -> set[int]:
        found: set[int] = set()
        for i in self._stage.code:
            if isinstance(i, Move):
                found |= {i.reg + c for c in range(self._comps(i))}
            elif isinstance(i, Transfer):
                found |= {i.offset + d for d in range(3)} | {i.share + k for k in range(SHARES)}
            elif isinstance(i, Call):
                found |= {*i.inputs, *(reg if reg >= 0 else ~reg for reg in i.outputs)}
            else:
                found |= {i.place + k for k in range(3)} | {i.out + k for k in range(11)}
        return found

    def _scratched(self, code: int) -> dict[Move, int]:
        """Moves to rows where others may come, with the place of their numbers."""
        wanted = [m for m in self._stage.moves(code) if code == ADD or self._is_active(m)]
        met = [m for m in wanted if m.table != SHARED and not self._source.is_direct(self._stage, m, code)]
        found, size = {}, 0
        for moves in self._by_field(met).values():  # a field's side by side
            for m in moves:
                found[m] = size
                size += self._comps(m) * self._stage.items
        self._rows[code] = size
        if self._stage.transfers(SPREAD if code == ADD else COLLECT):
            size += ROW * self._stage.items
        self._source.need(scratch=size)
        return found

    @staticmethod
    def _by_field(moves: Iterable[Move]) -> dict[int, list[Move]]:
        found: dict[int, list[Move]] = {}
        for m in moves:
            found.setdefault(m.field, []).append(m)
        return found

    def _gathered(self, target: str, moves: list[Move], scratch: dict[Move, int], how: str) -> Iterator[str]:
        first, entries = self._source.gather(self._stage, moves)
        comps, n, base = self._comps(moves[0]), self._stage.items, scratch[moves[0]]
        yield f"for (int v = T; v < {self._fields[moves[0].field].rows}; v += THREADS) {{"
        yield f"    R {', '.join(f'a{c} = R(0)' for c in range(comps))};"
        yield f"    for (int e = h.tables[{first} + v]; e < h.tables[{first} + v + 1]; e++) {{"
        yield f"        const int at = {base} + h.tables[{entries} + e];"
        for c in range(comps):
            yield f"        a{c} += scratch[at + {c * n}];"
        yield "    }"
        for c in range(comps):
            yield f"    {target}[v * {comps} + {c}] {how} a{c};"
        yield "}"
        yield "SYNC();"

    def _reduced(self, sums: list[tuple[str, str]]) -> Iterator[str]:
        self._source.need(shared=len(sums))
        yield f"{{ const R own[{len(sums)}] = {{{', '.join(name for _, name in sums)}}};"
        yield f"  reduce(own, {len(sums)}, h.shared); }}"
        yield "if (T == 0) {"
        for k, (target, _) in enumerate(sums):
            yield f"    {target} += h.shared[{k}];"
        yield "}"
        yield "SYNC();"

    def _if_wanted(self, field: int, lines: Iterator[str]) -> Iterator[str]:
        """Gradients of inputs may not be asked for."""
        if self._fields[field].kind not in (Kind.PARAMETER, Kind.DRIVE):
            yield from lines
            return
        yield f"if (g{field}) {{"
        yield from (f"    {line}" for line in lines)
        yield "}"

    def _moved_back(self, m: Move, scratch: dict[Move, int], shared: dict[tuple[int, int], str]) -> Iterator[str]:
        if not self._is_active(m):
            return
        asked = f"if (g{m.field}) " if self._fields[m.field].kind in (Kind.PARAMETER, Kind.DRIVE) else ""
        for c in range(self._comps(m)):
            place, bar = f"g{m.field}[{self._place(m, c)}]", f"b{m.reg + c}"
            if m.code != LOAD:
                yield f"    {bar} += {place};"
                if m.code == PUT:  # what was there before does not count any more
                    yield f"    {place} = R(0);"
            elif m.table == SHARED:
                yield f"    {shared[m.field, c]} += {bar};"
            elif m in scratch:
                yield f"    {asked}{self._slot(scratch[m], c)} = {bar};"
            else:
                yield f"    {asked}{place} += {bar};"


def _arms(i: Transfer) -> str:
    return str(i.by == By.ARMS).lower()
