"""A program as CUDA C++: one block of threads for each scene, many substeps in one launch.

Threads share the items of each stage and wait for each other between stages. What several items add to one row they
write down first, and the row's thread adds it up: results do not depend on who comes first. The adjoint goes through
some substeps again from the state where they begin, keeps the states on the way, and each substep's fields anew.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch

from ..fields import Kind
from ..loops import ADD, LOAD, OWN, PUT, SHARED, SPREAD, VARYING
from ..stages import Shape
from .emit_contact import HERE, OfLayers, OfPerMass
from .emit_loops import OfLoop
from .emit_stencils import OfStencil
from .program_ir import Layers, Listing, Loop, Move, PerMass, Place, Stage, Stencil, listing

WITHIN = (Kind.TEMPORARY, Kind.KEPT)
INNER = (*WITHIN, Kind.POINTS)
COMMON = "const Port* ports, const R* data, const int* tables, R* work, unsigned char* masks, int* grids"
PRELUDE = """
typedef {real} R;
#ifndef ON_HOST
#define WARP 32
#define SYNC() __syncthreads()
#define STAGE __device__
#define KERNEL extern "C" __global__ void __launch_bounds__(THREADS)
#define FIXED static __device__ const
#define ATOMIC_ADD atomicAdd
#define ATOMIC_CAS atomicCAS
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
// Whether it holds for any thread.
STAGE bool any(bool own, R* shared) {{
#if WARP > 1
    return __syncthreads_or(own);
#else
    volatile int* flag = reinterpret_cast<volatile int*>(shared);
    SYNC();
    if (T == 0) *flag = 0;
    SYNC();
    if (own) *flag = 1;
    SYNC();
    const bool found = *flag;
    SYNC();
    return found;
#endif
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
    FIXED, ATOMIC_ADD, ATOMIC_CAS, SCENE and T.
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
        self._fields, self.layers = self.of.fields, self.of.layers
        self._data = self._constants()
        self._contact = None if self.layers is None else OfLayers(self, self.layers, set())
        self.lasting = self._lasting()
        self.active = self._with_derivatives()
        stages = [line for k in range(len(self.of.stages)) for line in self._stage(k)]
        contact = [] if self._contact is None else [self._contact.text()]
        body = [prelude(dtype), *contact, *self._here(), *stages, *self._values(), *self._adjoint()]
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

    def own_table(self, numbers: np.ndarray) -> int:
        """Where a table of our own begins."""
        key = numbers.astype(np.int32).tobytes()
        if key not in self._at:
            self._at[key] = len(self._tables)
            self._tables.append(numbers.astype(np.int32).ravel())
        return self.table(self._at[key])

    def corner(self, which: int) -> int:
        """Where the corners of all triangles in contact begin."""
        if self.layers is None:
            raise ValueError("no contact")
        return self.own_table(self.layers.corners[which])

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
        """Two states, fields within a substep, sums, nodes, and what is yet to be added up."""
        return 2 * self.state_size + self._inner[1] + self._scratch + self._reference

    @property
    def _inner(self) -> tuple[dict[int, int], int]:
        return self._laid_out(*INNER, Kind.SUM, Kind.NODES)

    @property
    def _reference(self) -> int:
        """Positions at the last search for layers."""
        return 0 if self.layers is None else self._fields[self.layers.x].size

    @property
    def grid_size(self) -> int:
        """Integers of a scene for the nodes of contact."""
        return 0 if self._contact is None else self._contact.memory

    @property
    def room(self) -> int:
        """Nodes of contact that a scene may have."""
        return 0 if self.layers is None else self.layers.room

    @property
    def mask_size(self) -> int:
        """Bytes of a substep, that say which triangles take part."""
        return 0 if self.layers is None else self.layers.triangles

    @property
    def adjoint_size(self) -> int:
        """The same with adjoints; ``state_size`` more for every substep."""
        return self.values_size + 2 * self.state_size + self._inner[1]

    def _with_derivatives(self) -> set[int]:
        found = {k for k, _ in self._some(Kind.PARAMETER, Kind.STATE, Kind.DRIVE, Kind.NEXT, Kind.SUM, Kind.NODES)}
        for stage in self.of.stages:
            if isinstance(stage, Stencil):
                found |= {stage.x, stage.y}
            elif isinstance(stage, Loop) and not stage.flat:
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
        if self.layers is not None:
            yield HERE
        yield "};"

    # -- stages -------------------------------------------------------------------------------------------------------

    def _stage(self, k: int) -> Iterator[str]:
        """Functions ``stage`` and ``back`` of one."""
        stage = self.of.stages[k]
        emit = _EMIT[type(stage)](self, stage, self._begins(k))
        for name, lines in (("stage", emit.forward()), ("back", emit.reverse())):
            yield f"STAGE void {name}{k}(Here& h) {{"
            yield from (f"    {line}" for line in lines)
            yield "}"

    def _begins(self, k: int) -> set[int]:
        """Fields within a substep that no stage before this one has written to."""
        written = {f for stage in self.of.stages[:k] for f in _written(stage)}
        return {f for f in _written(self.of.stages[k]) if f not in written and self._fields[f].kind in _FRESH}

    def _blank(self) -> list[int]:
        """Fields that must be zero when a substep begins."""
        filled = {f for k, stage in enumerate(self.of.stages) for f in self._begins(k) if self.fills(stage, f)}
        return [k for k, _ in self._some(*WITHIN) if k not in filled]

    def fills(self, stage: Stage, field: int) -> bool:
        """Whether a stage writes to all rows, if it begins."""
        if not isinstance(stage, Loop):
            return True
        if stage.counted >= 0:
            return False
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
        rows = self._rows(stage, move)
        return len(np.unique(rows)) == len(rows)

    def _rows(self, stage: Loop, move: Move) -> np.ndarray:
        """Of all items."""
        if move.table == OWN:
            return np.arange(stage.items)
        if move.table <= VARYING and self.layers is not None:
            return self.layers.rows(stage.listed(move.table))
        return self._tables[move.table][: stage.items]

    def gather(self, stage: Loop, moves: Sequence[Move]) -> tuple[int, int]:
        """Where two tables begin, for a field to whose rows several items add: first entries, and places in scratch."""
        rows = [self._rows(stage, m) for m in moves]
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
        return self.own_table(first), self.own_table(places[order])

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
        within, size = self._inner
        for k, place in within.items():
            yield f"    h.f{k} = own + {place};"
        yield f"    h.scratch = own + {size};"
        yield f"    R* states = own + {size + self._scratch + self._reference};"
        if self._contact is not None:
            yield f"    h.reference = own + {size + self._scratch}, h.knows = {str(adjoint).lower()};"
            kept = "all" if adjoint else "(keeps ? substeps : 2)"
            every = f"(Count({kept}) * {self.mask_size} + 1)"
            yield f"    h.keeps = {'true' if adjoint else 'keeps'};"
            yield f"    h.masks = masks + scene * {every}, h.all = {'all' if adjoint else 'substeps'};"
            yield from self._contact.places()
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

    def _substep(self, number: str) -> Iterator[str]:
        if self._contact is not None:
            yield f"        h.step = {number};"
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
        places = self._laid_out(Kind.STATE)[0]
        yield f"KERNEL values({COMMON},"
        yield "              const Count* ends, int substeps, int frames, int keeps) {"
        yield from self._begin(adjoint=False)
        yield from self._loaded()
        for k, f in self._some(Kind.SUM):
            yield f"    clear(h.f{k}, {f.size});"
        yield "    SYNC();"
        yield f"    R *now = states, *after = states + {size};"
        yield "    for (int k = 0, frame = 0; k < substeps; k++) {"
        yield from self._point("now", "after")
        yield from self._drives("k", adjoint=False)
        yield from self._substep("k")
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
        if self._contact is not None:  # whether there was no room for nodes
            yield f"    if (T == 0) h.masks[Count(keeps ? substeps : 2) * {self.mask_size}] = h.nodes.totals[3];"
        yield "}"

    def _adjoint(self) -> Iterator[str]:
        size, last = self.state_size, len(self.of.stages) - 1
        yield "// From the seeds of the last of some substeps, of `all`, to the gradients before the first of them."
        yield f"KERNEL adjoint({COMMON},"
        yield "               int substeps, int first, int all) {"
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
        yield from self._substep("first + k")
        yield "        if (there) continue;"
        for k, f in self._some(*WITHIN):
            if k in self.active:
                yield f"        clear(h.g{k}, {f.size});"
        if self._contact is not None:
            points = [(k, f) for k, f in self._some(Kind.POINTS) if k in self.active]
            yield "        if (h.some) " + ", ".join(f"clear(h.g{k}, {f.size})" for k, f in points) + ";"
            yield from self._contact.cleared()
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


def _written(stage: Stage) -> list[int]:
    if isinstance(stage, Stencil):
        return [stage.x if stage.shape == Shape.TRANSPOSED else stage.y]
    if isinstance(stage, Loop):
        return [m.field for m in (*stage.moves(ADD, PUT), *stage.transfers(SPREAD))]
    return [stage.out] if isinstance(stage, PerMass) else []


_FRESH = (*WITHIN, Kind.NODES)  # written anew in every substep
_EMIT: dict[type, Any] = {Loop: OfLoop, Stencil: OfStencil, Layers: OfLayers, PerMass: OfPerMass}
