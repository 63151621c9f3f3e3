"""A program as CUDA C++: one block of threads for each scene, many substeps in one launch.

Threads share the items of each stage and wait for each other between stages. What several items add to one row they
write down first, and the row's thread adds it up: results do not depend on who comes first. The adjoint goes through
some substeps again from the state where they begin, keeps the states on the way, and each substep's fields anew.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from ..fields import Kind
from ..loops import ADD, LOAD, OWN, PUT, SHARED
from ..stages import Shape
from .arithmetic import kernel
from .listing import Call, Listing, Loop, Move, Place, Stencil, listing

WITHIN = (Kind.TEMPORARY, Kind.KEPT)
PRELUDE = """
typedef {real} R;
#ifndef ON_HOST
#define WARP 32
#define SYNC() __syncthreads()
#define STAGE __device__
#define KERNEL extern "C" __global__ void __launch_bounds__(THREADS)
#define SCENE blockIdx.x
#define T int(threadIdx.x)
extern __shared__ double shared_memory[];
#endif
#define WARPS (THREADS / WARP)
typedef long long Count;

struct Port {{
    R* value;
    Count stride;
    R* result;
    R* seed;
    R* gradient;
}};

// Sums of n numbers over all threads, in memory that they share.
STAGE void reduce(const R* own, int n, R* shared) {{
    for (int c = 0; c < n; c++) {{
        R sum = own[c];
#if WARP > 1
        for (int step = WARP / 2; step > 0; step /= 2) sum += __shfl_down_sync(0xffffffffu, sum, step);
#endif
        if (T % WARP == 0) shared[n + c * WARPS + T / WARP] = sum;
    }}
    SYNC();
    for (int c = T; c < n; c += THREADS) {{
        R sum = R(0);
        for (int w = 0; w < WARPS; w++) sum += shared[n + c * WARPS + w];
        shared[c] = sum;
    }}
    SYNC();
}}
STAGE void copy(R* to, const R* from, int count) {{
    for (int i = T; i < count; i += THREADS) to[i] = from[i];
}}
STAGE void clear(R* to, int count) {{
    for (int i = T; i < count; i += THREADS) to[i] = R(0);
}}
"""


class Source:
    """The text, with what it reads.

    Attributes:
        text: of one precision; THREADS, and for another compiler WARP, SYNC, STAGE, KERNEL, SCENE and T, are given by it.
        data: constants, one after the other.
        tables: indices, likewise.
        values_size, adjoint_size: numbers of work memory for a scene, of the adjoint for one substep and
        ``state_size`` more for each.
        shared: numbers that the threads of a block share, times (1 + warps).
    """

    def __init__(self, written: Sequence[tuple[str, tuple]], real: str) -> None:
        self.of: Listing = listing(written)
        self.shared = 1
        self._tables = [np.asarray(t, np.int32).ravel() for t in self.of.tables]
        self._at: dict[bytes, int] = {}
        self._scratch = 0
        self._fields = self.of.fields
        self._data = self._constants()
        self._sums = self._lasting()
        self._active = self._with_derivatives()
        stages = [line for k in range(len(self.of.stages)) for line in self._stage(k)]
        body = [PRELUDE.format(real=real), *self._here(), *stages, *self._values(), *self._adjoint()]
        self.text = "\n".join(body) + "\n"

    # -- memory -------------------------------------------------------------------------------------------------------

    def _constants(self) -> dict[int, int]:
        """Where each begins."""
        found, parts, size = {}, [], 0
        for k, field in enumerate(self._fields):
            if field.kind == Kind.CONSTANT and field.data is not None:
                found[k] = size
                parts.append(field.data.ravel())
                size += field.size
        self.data = np.concatenate(parts) if parts else np.zeros(1)
        return found

    @property
    def tables(self) -> np.ndarray:
        """All of them."""
        return np.concatenate([*self._tables, np.zeros(1, np.int32)])

    def _table(self, which: int) -> int:
        return sum(len(t) for t in self._tables[:which])

    def _index(self, numbers: np.ndarray) -> int:
        """Where a table of our own begins."""
        key = numbers.astype(np.int32).tobytes()
        if key not in self._at:
            self._at[key] = len(self._tables)
            self._tables.append(numbers.astype(np.int32).ravel())
        return self._table(self._at[key])

    def _some(self, *kinds: Kind) -> list[tuple[int, Place]]:
        return [(k, f) for k, f in enumerate(self._fields) if f.kind in kinds]

    def _laid_out(self, *kinds: Kind) -> tuple[dict[int, int], int]:
        """(where each field of some kinds begins, all their numbers)."""
        found, size = {}, 0
        for k, field in self._some(*kinds):
            found[k] = size
            size += field.size
        return found, size

    @property
    def state_size(self) -> int:
        """Numbers of a state."""
        return self._laid_out(Kind.STATE)[1]

    @property
    def values_size(self) -> int:
        """Two states, fields within a substep, sums, and what is yet to be added up."""
        return 2 * self.state_size + self._laid_out(*WITHIN, Kind.SUM)[1] + self._scratch

    @property
    def adjoint_size(self) -> int:
        """The same with adjoints, without the states of further substeps."""
        return self.values_size + 2 * self.state_size + self._laid_out(*WITHIN, Kind.SUM)[1]

    def _with_derivatives(self) -> set[int]:
        found = {k for k, _ in self._some(Kind.PARAMETER, Kind.STATE, Kind.DRIVE, Kind.NEXT, Kind.SUM)}
        for stage in self.of.stages:
            if isinstance(stage, Stencil):
                found |= {stage.x, stage.y}
            elif not stage.flat:
                found |= {m.field for m in stage.moves(ADD, PUT)}
        return {k for k in found if self._fields[k].kind != Kind.CONSTANT}

    def _lasting(self) -> dict[tuple[int, int], int]:
        """Adjoints of parameters that all items share, which each thread adds up until the end: places in Here::sums."""
        loops = [stage for stage in self.of.stages if isinstance(stage, Loop) and not stage.flat]
        loads = [m for loop in loops for m in loop.moves(LOAD) if m.table == SHARED]
        shared = {m.field: None for m in loads if self._fields[m.field].kind == Kind.PARAMETER}
        return {place: k for k, place in enumerate((f, c) for f in shared for c in range(self._fields[f].comps))}

    def _here(self) -> Iterator[str]:
        """What all stages see."""
        yield "struct Here {"
        for k in range(len(self._fields)):
            yield f"    R *f{k}, *g{k};"
        yield f"    R *scratch, *shared, sums[{max(len(self._sums), 1)}];"
        yield "    const int* tables;"
        yield "};"

    # -- stages -------------------------------------------------------------------------------------------------------

    def _stage(self, k: int) -> Iterator[str]:
        """Functions ``stage`` and ``back`` of one."""
        stage = self.of.stages[k]
        emit = (_OfLoop if isinstance(stage, Loop) else _OfStencil)(self, stage, self._begins(k))
        for name, lines in (("stage", emit.forward()), ("back", emit.reverse())):
            yield f"STAGE void {name}{k}(Here& h) {{"
            yield from (f"    {line}" for line in lines)
            yield "}"

    def _begins(self, k: int) -> set[int]:
        """Fields within a substep that no stage before this one has written to."""
        written = {f for stage in self.of.stages[:k] for f in _written(stage)}
        return {f for f in _written(self.of.stages[k]) if f not in written and self._fields[f].kind in WITHIN}

    def _blank(self) -> list[int]:
        """Fields that must be zero when a substep begins."""
        filled = {f for k, stage in enumerate(self.of.stages) for f in self._begins(k) if self.fills(stage, f)}
        return [k for k, _ in self._some(*WITHIN) if k not in filled]

    def fills(self, stage: Loop | Stencil, field: int) -> bool:
        """Whether a stage writes to all rows, if it begins."""
        if isinstance(stage, Stencil):
            return True
        own = self._fields[field]
        return all(
            (m.table == OWN and stage.items == own.rows)
            or (m.code == PUT if m.table == SHARED else m.code == ADD and not self.is_direct(stage, m, ADD))
            for m in stage.moves(ADD, PUT)
            if m.field == field
        )  # fmt: skip

    def is_direct(self, stage: Loop, move: Move, code: int) -> bool:
        """No two items, and no two instructions, come to the same row."""
        if move.table == SHARED or sum(m.field == move.field for m in stage.moves(code)) > 1:
            return False
        return move.table == OWN or len(np.unique(self._tables[move.table])) == len(self._tables[move.table])

    def gather(self, stage: Loop, moves: Sequence[Move]) -> tuple[int, int]:
        """Where two tables begin, for a field to whose rows several items add: first entries, and places in scratch."""
        rows = [np.arange(stage.items) if m.table == OWN else self._tables[m.table][: stage.items] for m in moves]
        comps, n = self._fields[moves[0].field].comps, stage.items
        places = np.concatenate([k * comps * n + np.arange(n) for k in range(len(moves))])
        return self._sorted(np.concatenate(rows), places, self._fields[moves[0].field].rows)

    def inverse(self, near: int, vertices: int) -> tuple[int, int]:
        """Likewise, for the vertices that see each vertex: n V + v of each."""
        table = self._tables[near]
        entries = np.arange(len(table))
        real = table != entries % vertices
        return self._sorted(table[real], entries[real], vertices)

    def _sorted(self, rows: np.ndarray, places: np.ndarray, count: int) -> tuple[int, int]:
        order = np.argsort(rows, kind="stable")
        first = np.searchsorted(rows[order], np.arange(count + 1))
        return self._index(first), self._index(places[order])

    def need(self, scratch: int = 0, shared: int = 0) -> None:
        """Memory that a stage wants."""
        self._scratch, self.shared = max(self._scratch, scratch), max(self.shared, shared)

    # -- kernels ------------------------------------------------------------------------------------------------------

    def _begin(self, adjoint: bool) -> Iterator[str]:
        """Fields' places, of all that do not change from substep to substep."""
        own = self.adjoint_size if adjoint else self.values_size
        yield "    Here h;"
        yield "    const Count scene = SCENE;"
        yield f"    R* own = work + scene * ({own} + {'substeps * ' + str(self.state_size) if adjoint else '0'});"
        yield "    h.tables = tables, h.shared = reinterpret_cast<R*>(shared_memory);"
        for k, place in self._data.items():
            yield f"    h.f{k} = const_cast<R*>(data) + {place};"
        for k, _ in self._some(Kind.PARAMETER):
            yield f"    h.f{k} = ports[{k}].value + scene * ports[{k}].stride;"
        within, size = self._laid_out(*WITHIN, Kind.SUM)
        for k, place in within.items():
            yield f"    h.f{k} = own + {place};"
        yield f"    h.scratch = own + {size};"
        yield f"    R* states = own + {size + self._scratch};"
        if adjoint:
            for k, place in within.items():
                yield f"    h.g{k} = states + (substeps + 2) * {self.state_size} + {2 * self.state_size + place};"
            for k, f in self._some(Kind.PARAMETER):
                yield f"    h.g{k} = ports[{k}].gradient ? ports[{k}].gradient + scene * {f.size} : nullptr;"
            for place in self._sums.values():
                yield f"    h.sums[{place}] = R(0);"

    def _drives(self, row: str, adjoint: bool) -> Iterator[str]:
        for k, f in self._some(Kind.DRIVE):
            yield f"        h.f{k} = ports[{k}].value + scene * ports[{k}].stride + {row} * {f.comps};"
            if adjoint:
                at = f"(scene * all + {row}) * {f.comps}"
                yield f"        h.g{k} = ports[{k}].gradient ? ports[{k}].gradient + {at} : nullptr;"

    def _substep(self) -> Iterator[str]:
        for k in self._blank():
            yield f"        clear(h.f{k}, {self._fields[k].size});"
        if self._blank():
            yield "        SYNC();"
        for k in range(len(self.of.stages)):
            yield f"        stage{k}(h);"

    def _loaded(self) -> Iterator[str]:
        """The first state."""
        for k, place in self._laid_out(Kind.STATE)[0].items():
            count = self._fields[k].size
            yield f"    copy(states + {place}, ports[{k}].value + scene * ports[{k}].stride, {count});"

    def _point(self, now: str, after: str, letter: str = "f") -> Iterator[str]:
        for k, place in self._laid_out(Kind.STATE)[0].items():
            yield f"        h.{letter}{k} = {now} + {place}, h.{letter}{self.of.next[k]} = {after} + {place};"

    def _values(self) -> Iterator[str]:
        size = self.state_size
        x, places = self._some(Kind.STATE)[0], self._laid_out(Kind.STATE)[0]
        yield "KERNEL values(const Port* ports, const R* data, const int* tables, R* work, R* far, const Count* ends,"
        yield "              int substeps, int frames) {"
        yield from self._begin(adjoint=False)
        yield from self._loaded()
        for k, f in self._some(Kind.SUM):
            yield f"    clear(h.f{k}, {f.size});"
        yield "    SYNC();"
        yield f"    R *now = states, *after = states + {size}, farthest = R(0);"
        yield f"    const R* start = ports[{x[0]}].value + scene * ports[{x[0]}].stride;"
        yield "    for (int k = 0, frame = 0; k < substeps; k++) {"
        yield f"        for (int i = T; i < {x[1].size}; i += THREADS) {{"
        yield f"            const R way = now[{places[x[0]]} + i] - start[i], far_now = way < R(0) ? -way : way;"
        yield "            farthest = far_now > farthest ? far_now : farthest;"
        yield "        }"
        yield from self._point("now", "after")
        yield from self._drives("k", adjoint=False)
        yield from self._substep()
        yield "        R* swapped = now; now = after, after = swapped;"
        yield "        if (k + 1 != ends[frame]) continue;"
        for k, place in places.items():
            f = self._fields[k]
            to = f"ports[{self.of.next[k]}].result + (scene * frames + frame) * {f.size}"
            yield f"        copy({to}, now + {place}, {f.size});"
        for k, f in self._some(Kind.SUM):
            yield f"        copy(ports[{k}].result + (scene * frames + frame) * {f.size}, h.f{k}, {f.size});"
        yield "        SYNC();"
        for k, f in self._some(Kind.SUM):
            yield f"        clear(h.f{k}, {f.size});"
        yield "        SYNC();"
        yield "        frame++;"
        yield "    }"
        yield "    far[scene * THREADS + T] = farthest;"
        yield "}"

    def _adjoint(self) -> Iterator[str]:
        size, last = self.state_size, len(self.of.stages) - 1
        yield "// From the seeds of the last of some substeps, of `all`, to the gradients before the first of them."
        yield "KERNEL adjoint(const Port* ports, const R* data, const int* tables, R* work, int substeps, int first, int all) {"
        yield from self._begin(adjoint=True)
        yield from self._loaded()
        yield f"    R *seed = states + (substeps + 2) * {size}, *given = seed + {size};"
        for k, place in self._laid_out(Kind.STATE)[0].items():
            count = self._fields[k].size
            yield f"    copy(seed + {place}, ports[{self.of.next[k]}].seed + scene * {count}, {count});"
        for k, f in self._some(Kind.SUM):
            yield f"    copy(h.g{k}, ports[{k}].seed + scene * {f.size}, {f.size}), clear(h.f{k}, {f.size});"
        yield "    SYNC();"
        yield "    for (int step = 0; step < 2 * substeps - 1; step++) {"
        yield "        const bool there = step < substeps - 1;  // on the way to the last state but one"
        yield "        const int k = there ? step : 2 * substeps - 2 - step;"
        yield f"        R* now = states + k * {size};"
        yield from self._point("now", f"(now + {size})")
        yield from self._drives("(first + k)", adjoint=True)
        yield from self._substep()
        yield "        if (there) continue;"
        for k, f in self._some(*WITHIN):
            if k in self._active:
                yield f"        clear(h.g{k}, {f.size});"
        yield f"        clear(given, {size});"
        yield from self._point("given", "seed", "g")
        yield "        SYNC();"
        for k in range(last, -1, -1):
            yield f"        back{k}(h);"
        yield "        R* swapped = seed; seed = given, given = swapped;"
        yield "    }"
        for k, place in self._laid_out(Kind.STATE)[0].items():
            count = self._fields[k].size
            yield f"    if (ports[{k}].gradient) copy(ports[{k}].gradient + scene * {count}, seed + {place}, {count});"
        if self._sums:
            self.need(shared=len(self._sums))
            yield f"    reduce(h.sums, {len(self._sums)}, h.shared);"
            yield "    if (T != 0) return;"
            for (k, c), place in self._sums.items():
                yield f"    if (h.g{k}) h.g{k}[{c}] += h.shared[{place}];"
        yield "}"


def _written(stage: Loop | Stencil) -> list[int]:
    if isinstance(stage, Stencil):
        return [stage.x if stage.shape == Shape.TRANSPOSED else stage.y]
    return [m.field for m in stage.moves(ADD, PUT)]


class _OfLoop:
    """Functions of a loop."""

    def __init__(self, source: Source, stage: Loop, begins: set[int]) -> None:
        self._source, self._stage, self._begins, self._fields = source, stage, begins, source.of.fields

    def forward(self) -> Iterator[str]:
        """Values."""
        sums = [(m, c) for m in self._stage.moves(ADD) if m.table == SHARED for c in range(self._comps(m))]
        shared = {(m.field, c): f"s{k}" for k, (m, c) in enumerate(sums)}
        scratch = self._scratched(ADD)
        yield from self._pointers("f")
        if sums:
            yield f"R {', '.join(f'{name} = R(0)' for name in shared.values())};"
        yield from self._items()
        for n, i in enumerate(self._stage.code):
            if not isinstance(i, Move):
                yield from self._computed(n)
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
                    yield f"    scratch[{scratch[i] + c * self._stage.items} + i] = {reg};"
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
        if shared:
            yield from self._reduced([(f"h.f{field}[{c}]", name) for (field, c), name in shared.items()])

    def reverse(self) -> Iterator[str]:
        """Adjoints."""
        if self._stage.flat:
            return
        scratch = {m: at for m, at in self._scratched(LOAD).items() if self._is_active(m)}
        loads = [m for m in self._stage.moves(LOAD) if self._is_active(m) and m.table == SHARED]
        shared = {(m.field, c): f"s{k}_{c}" for k, m in enumerate(loads) for c in range(self._comps(m))}
        yield from self._pointers("f")
        yield from self._pointers("g")
        if shared:
            yield f"R {', '.join(f'{name} = R(0)' for name in shared.values())};"
        yield from self._items()
        for n, i in enumerate(self._stage.code):
            if not isinstance(i, Move):
                yield from self._computed(n)
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
            else:
                for k in range(3):
                    yield f"    b{i.place + k} += b{i.out + k};"
        yield "}"
        yield "SYNC();"
        for field, moves in self._by_field(scratch).items():
            yield from self._if_wanted(field, self._gathered(f"g{field}", moves, scratch, "+="))
        for field in {field: None for field, _ in shared}:
            own = [(c, name) for (f, c), name in shared.items() if f == field]
            if self._fields[field].kind == Kind.PARAMETER:  # until the end
                yield from (f"h.sums[{self._source._sums[field, c]}] += {name};" for c, name in own)
            else:
                yield from self._if_wanted(field, self._reduced([(f"g{field}[{c}]", name) for c, name in own]))

    # -- parts of the above -------------------------------------------------------------------------------------------

    def _comps(self, move: Move) -> int:
        return self._fields[move.field].comps

    def _is_active(self, move: Move) -> bool:
        return move.field in self._source._active

    def _pointers(self, letter: str) -> Iterator[str]:
        """In registers."""
        read = {i.field for i in self._stage.code if not isinstance(i, Call)}
        for field in sorted(read):
            if letter == "f" or field in self._source._active:
                yield f"R* const {letter}{field} = h.{letter}{field};"
        if letter == "f":
            yield "R* const scratch = h.scratch;"

    def _items(self) -> Iterator[str]:
        yield f"for (int i = T; i < {self._stage.items}; i += THREADS) {{"
        for table in sorted({m.table for m in self._stage.moves(LOAD, ADD, PUT) if m.table >= 0}):
            yield f"    const int w{table} = h.tables[{self._source._table(table)} + i];"

    def _place(self, move: Move, c: int) -> str:
        if move.table == SHARED:
            return str(c)
        return f"{'i' if move.table == OWN else f'w{move.table}'} * {self._comps(move)} + {c}"

    def _computed(self, n: int) -> Iterator[str]:
        """Values of a call or a lookup."""
        i = self._stage.code[n]
        if isinstance(i, Call):
            found = kernel(i.kernel)
            yield from (f"    {line}" for line in found.values(f"n{n}_", [f"r{reg}" for reg in i.inputs]))
            for reg, out in zip(i.outputs, found.out, strict=True):
                yield f"    R r{reg} = n{n}_{out};" if reg >= 0 else f"    r{~reg} += n{n}_{out};"
            return
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
            elif isinstance(i, Call):
                found |= {*i.inputs, *(reg if reg >= 0 else ~reg for reg in i.outputs)}
            else:
                found |= {i.place + k for k in range(3)} | {i.out + k for k in range(11)}
        return found

    def _scratched(self, code: int) -> dict[Move, int]:
        """Moves to rows where others may come, with the place of their numbers."""
        found, size = {}, 0
        for m in self._stage.moves(code):
            if m.table != SHARED and not self._source.is_direct(self._stage, m, code):
                if code == LOAD and not self._is_active(m):
                    continue
                found[m] = size
                size += self._comps(m) * self._stage.items
        by_field = self._by_field(found)  # a field's side by side
        found, size = {}, 0
        for moves in by_field.values():
            for m in moves:
                found[m] = size
                size += self._comps(m) * self._stage.items
        self._source.need(scratch=size)
        return found

    @staticmethod
    def _by_field(moves: dict[Move, int]) -> dict[int, list[Move]]:
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
                yield f"    {asked}scratch[{scratch[m] + c * self._stage.items} + i] = {bar};"
            else:
                yield f"    {asked}{place} += {bar};"


class _OfStencil:
    """Functions of a stencil: y_c(v) += sum_n w_c(n, v) (x(near(n, v)) - x(v)), and its transposes."""

    def __init__(self, source: Source, stage: Stencil, begins: set[int]) -> None:
        self._source, self._stage, self._begins = source, stage, begins
        fields = source.of.fields
        self._vertices = fields[stage.x].rows
        self._near = fields[stage.weight].near
        self._count = fields[stage.weight].size // self._near // self._vertices

    def forward(self) -> Iterator[str]:
        """Values."""
        x, y, transposed = self._stage.x, self._stage.y, self._stage.shape == Shape.TRANSPOSED
        to = x if transposed else y
        how = "=" if to in self._begins else "+="
        yield from (
            self._answer(f"h.f{y}", f"h.f{x}", how, "") if transposed else self._see(f"h.f{x}", f"h.f{y}", how, "")
        )

    def reverse(self) -> Iterator[str]:
        """Adjoints."""
        x, y, shape = self._stage.x, self._stage.y, self._stage.shape
        if shape == Shape.TRANSPOSED:
            yield from self._see(f"h.g{x}", f"h.g{y}", "+=", "-")
            yield from self._weigh(f"h.g{x}", f"h.f{y}", "-")
        else:
            if shape == Shape.SYMMETRIC:
                yield from self._see(f"h.g{y}", f"h.g{x}", "+=", "")
            else:
                yield from self._answer(f"h.g{y}", f"h.g{x}", "+=", "-")
            yield from self._weigh(f"h.f{x}", f"h.g{y}", "")

    def _each(self) -> Iterator[str]:
        yield f"for (int v = T; v < {self._vertices}; v += THREADS) {{"

    def _neighbours(self) -> Iterator[str]:
        yield f"    for (int n = 0; n < {self._near}; n++) {{"
        yield f"        const int at = n * {self._vertices} + v, o = h.tables[{self._source._table(self._stage.table)} + at];"
        yield "        if (o == v) continue;"

    def _weight(self, c: int, at: str = "at") -> str:
        return f"w[{c * self._near * self._vertices} + {at}]"

    def _sums(self, parts: int) -> str:
        return f"    R {', '.join(f'a{k} = R(0)' for k in range(parts))};"

    def _see(self, given: str, to: str, how: str, sign: str) -> Iterator[str]:
        yield f"const R *w = h.f{self._stage.weight}, *from = {given};"
        yield f"R* to = {to};"
        yield from self._each()
        yield self._sums(3 * self._count)
        yield "    const R x0 = from[3 * v], x1 = from[3 * v + 1], x2 = from[3 * v + 2];"
        yield from self._neighbours()
        yield "        const R d0 = from[3 * o] - x0, d1 = from[3 * o + 1] - x1, d2 = from[3 * o + 2] - x2;"
        for c in range(self._count):
            yield f"        const R w{c} = {self._weight(c)};"
            yield "        " + " ".join(f"a{3 * c + k} += w{c} * d{k};" for k in range(3))
        yield "    }"
        for k in range(3 * self._count):
            yield f"    to[{3 * self._count} * v + {k}] {how} {sign}a{k};"
        yield "}"
        yield "SYNC();"

    def _answer(self, given: str, to: str, how: str, sign: str) -> Iterator[str]:
        """Minus the transpose; ``sign`` "-": the transpose."""
        first, entries = self._source.inverse(self._stage.table, self._vertices)
        row = 3 * self._count
        yield f"const R *w = h.f{self._stage.weight}, *from = {given};"
        yield f"R* to = {to};"
        yield from self._each()
        yield self._sums(3)
        yield f"    R {', '.join(f'own{c} = R(0)' for c in range(self._count))};"
        yield from self._neighbours()
        yield "        " + " ".join(f"own{c} += {self._weight(c)};" for c in range(self._count))
        yield "    }"
        for c in range(self._count):
            yield "    " + " ".join(f"a{k} += own{c} * from[{row} * v + {3 * c + k}];" for k in range(3))
        yield f"    for (int e = h.tables[{first} + v]; e < h.tables[{first} + v + 1]; e++) {{"
        yield f"        const int at = h.tables[{entries} + e], o = at % {self._vertices};"
        for c in range(self._count):
            yield f"        const R w{c} = {self._weight(c)};"
            yield "        " + " ".join(f"a{k} -= w{c} * from[{row} * o + {3 * c + k}];" for k in range(3))
        yield "    }"
        for k in range(3):
            yield f"    to[3 * v + {k}] {how} {sign}a{k};"
        yield "}"
        yield "SYNC();"

    def _weigh(self, x: str, y: str, sign: str) -> Iterator[str]:
        """The gradient of the weights, where they are an input."""
        weight = self._stage.weight
        if self._source.of.fields[weight].kind == Kind.CONSTANT:
            return
        row = 3 * self._count
        yield f"if (h.g{weight}) {{"
        yield f"    const R *seen = {x}, *moment = {y};"
        yield from (f"    {line}" for line in self._each())
        yield from (f"    {line}" for line in self._neighbours())
        for c in range(self._count):
            dots = " + ".join(
                f"(seen[3 * o + {k}] - seen[3 * v + {k}]) * moment[{row} * v + {3 * c + k}]" for k in range(3)
            )
            yield f"            h.g{weight}[{c * self._near * self._vertices} + at] += {sign}({dots});"
        yield "        }"
        yield "    }"
        yield "}"
        yield "SYNC();"
