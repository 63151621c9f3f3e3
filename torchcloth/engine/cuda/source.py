"""A program as CUDA C++: one block of threads for each scene, many substeps in one launch.

Threads share the items of each stage and wait for each other between stages. What several items add to one row they
write down first, and the row's thread adds it up: results do not depend on who comes first. The adjoint goes through
some substeps again from the state where they begin, keeps the states on the way, and each substep's fields anew.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import torch

from ..fields import Kind
from ..loops import ADD, LOAD, OWN, PUT, SHARED
from ..stages import Shape
from .listing import Listing, Loop, Move, Place, Stencil, listing
from .of_loops import OfLoop
from .of_stencils import OfStencil

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


def prelude(dtype: torch.dtype) -> str:
    """What kernels of one precision begin with.

    Whoever compiles them gives THREADS; for another compiler than CUDA's also ON_HOST, and WARP, SYNC, STAGE, KERNEL,
    SCENE and T.
    """
    return PRELUDE.format(real="double" if dtype == torch.float64 else "float")


class Source:
    """The text, with what it reads.

    Attributes:
        text: of one precision, see ``prelude``.
        data: constants, one after the other.
        shared: numbers that the threads of a block share, times (1 + warps).
    """

    def __init__(self, written: Sequence[tuple[str, tuple]], dtype: torch.dtype) -> None:
        self.of: Listing = listing(written)
        self.shared = 1
        self._tables = [np.asarray(t, np.int32).ravel() for t in self.of.tables]
        self._at: dict[bytes, int] = {}
        self._scratch = 0
        self._fields = self.of.fields
        self._data = self._constants()
        self.lasting = self._lasting()
        self.active = self._with_derivatives()
        stages = [line for k in range(len(self.of.stages)) for line in self._stage(k)]
        body = [prelude(dtype), *self._here(), *stages, *self._values(), *self._adjoint()]
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
        """Indices, one table after the other."""
        return np.concatenate([*self._tables, np.zeros(1, np.int32)])

    def table(self, which: int) -> int:
        """Where a table of the program begins."""
        return sum(len(t) for t in self._tables[:which])

    def _index(self, numbers: np.ndarray) -> int:
        """Where a table of our own begins."""
        key = numbers.astype(np.int32).tobytes()
        if key not in self._at:
            self._at[key] = len(self._tables)
            self._tables.append(numbers.astype(np.int32).ravel())
        return self.table(self._at[key])

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
        """The same with adjoints; ``state_size`` more for every substep."""
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
        """Adjoints of parameters that all items share, added up until the end: places in Here::sums."""
        loops = [stage for stage in self.of.stages if isinstance(stage, Loop) and not stage.flat]
        loads = [m for loop in loops for m in loop.moves(LOAD) if m.table == SHARED]
        shared = {m.field: None for m in loads if self._fields[m.field].kind == Kind.PARAMETER}
        return {place: k for k, place in enumerate((f, c) for f in shared for c in range(self._fields[f].comps))}

    def _here(self) -> Iterator[str]:
        """What all stages see."""
        yield "struct Here {"
        for k in range(len(self._fields)):
            yield f"    R *f{k}, *g{k};"
        yield f"    R *scratch, *shared, sums[{max(len(self.lasting), 1)}];"
        yield "    const int* tables;"
        yield "};"

    # -- stages -------------------------------------------------------------------------------------------------------

    def _stage(self, k: int) -> Iterator[str]:
        """Functions ``stage`` and ``back`` of one."""
        stage = self.of.stages[k]
        begins = self._begins(k)
        emit = OfLoop(self, stage, begins) if isinstance(stage, Loop) else OfStencil(self, stage, begins)
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
            for place in self.lasting.values():
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
        yield "KERNEL adjoint(const Port* ports, const R* data, const int* tables, R* work, int substeps, int first,"
        yield "               int all) {"
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
            if k in self.active:
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
        if self.lasting:
            self.need(shared=len(self.lasting))
            yield f"    reduce(h.sums, {len(self.lasting)}, h.shared);"
            yield "    if (T != 0) return;"
            for (k, c), place in self.lasting.items():
                yield f"    if (h.g{k}) h.g{k}[{c}] += h.shared[{place}];"
        yield "}"


def _written(stage: Loop | Stencil) -> list[int]:
    if isinstance(stage, Stencil):
        return [stage.x if stage.shape == Shape.TRANSPOSED else stage.y]
    return [m.field for m in stage.moves(ADD, PUT)]
