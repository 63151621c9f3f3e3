"""A program as CUDA C++: one block of threads for each scene, many substeps in one launch.

Threads share the items of each stage and wait for each other between stages. Numbers that several items add to one row
are first written to scratch memory, and the row's thread sums them. So results do not depend on the order of threads.
The adjoint repeats some substeps from the state where they begin, keeps the states on the way, and computes each
substep's fields anew.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import torch

from ..enums import FieldKind
from .emit_contact import SCENE_CONTEXT_MEMBERS, ContactSearchEmitter, GridVelocityEmitter
from .emit_loops import LoopEmitter
from .emit_stencils import StencilEmitter
from .layout import WITHIN_SUBSTEP, Layout
from .program_ir import ContactSearch, GridVelocity, Loop, Stencil

KERNEL_PARAMETERS = "const Port* ports, const R* data, const int* tables, R* work, unsigned char* masks, int* grids"
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

// Sums of n numbers over all threads, in the memory that they share.
STAGE void reduce(const R* numbers, int n, R* shared) {{
    for (int c = 0; c < n; c++) {{
        R sum = numbers[c];
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
STAGE bool any(bool holds, R* shared) {{
#if WARP > 1
    return __syncthreads_or(holds);
#else
    volatile int* flag = reinterpret_cast<volatile int*>(shared);
    SYNC();
    if (T == 0) *flag = 0;
    SYNC();
    if (holds) *flag = 1;
    SYNC();
    const bool result = *flag;
    SYNC();
    return result;
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
    """Return the text that precedes the kernels of one precision.

    Whoever compiles it defines THREADS. Another compiler than CUDA's also defines ON_HOST, and WARP, SYNC, STAGE,
    KERNEL, FIXED, ATOMIC_ADD, ATOMIC_CAS, SCENE and T.
    """
    return PRELUDE.format(real="double" if dtype == torch.float64 else "float")


class CudaModule(Layout):
    """A program as CUDA C++, with the memory that it reads.

    Attributes:
        text: the source of one precision, with the kernels ``values`` and ``adjoint``.
    """

    def __init__(self, calls: Sequence[tuple[str, tuple]], dtype: torch.dtype) -> None:
        super().__init__(calls)
        self._contact_emitter = None if self.contact is None else ContactSearchEmitter(self, self.contact, set())
        stages = [line for k in range(len(self.program.stages)) for line in self._stage_functions(k)]
        contact = [] if self._contact_emitter is None else [self._contact_emitter.text()]
        body = [prelude(dtype), *contact, *self._scene_context(), *stages, *self._values(), *self._adjoint()]
        self.text = "\n".join(body) + "\n"

    # -- stages -------------------------------------------------------------------------------------------------------

    def _scene_context(self) -> Iterator[str]:
        """The struct that all stages take."""
        yield "struct SceneContext {"
        for k in range(len(self.fields)):
            yield f"    R *f{k}, *g{k};"
        yield f"    R *scratch, *shared, sums[{max(len(self.accumulated), 1)}];"
        yield "    const int* tables;"
        if self.contact is not None:
            yield SCENE_CONTEXT_MEMBERS
        yield "};"

    def _stage_functions(self, k: int) -> Iterator[str]:
        """Functions ``stage`` and ``back`` of stage ``k``."""
        stage = self.program.stages[k]
        emitter = _EMITTERS[type(stage)](self, stage, self.first_written(k))
        for name, lines in (("stage", emitter.forward()), ("back", emitter.reverse())):
            yield f"STAGE void {name}{k}(SceneContext& h) {{"
            yield from (f"    {line}" for line in lines)
            yield "}"

    # -- kernels ------------------------------------------------------------------------------------------------------

    def _set_up(self, adjoint: bool) -> Iterator[str]:
        """Places of all fields that do not change from substep to substep."""
        size_of_scene = self.adjoint_size if adjoint else self.values_size
        more = "substeps * " + str(self.state_size) if adjoint else "0"
        yield "    SceneContext h;"
        yield "    const Count scene = SCENE;"
        yield f"    R* memory = work + scene * ({size_of_scene} + {more});"
        yield "    h.tables = tables, h.shared = reinterpret_cast<R*>(shared_memory);"
        for k, place in self._constant_places.items():
            yield f"    h.f{k} = const_cast<R*>(data) + {place};"
        for k, _ in self.fields_of(FieldKind.PARAMETER):
            yield f"    h.f{k} = ports[{k}].value + scene * ports[{k}].stride;"
        inner, size = self._inner
        for k, place in inner.items():
            yield f"    h.f{k} = memory + {place};"
        yield f"    h.scratch = memory + {size};"
        yield f"    R* states = memory + {size + self._scratch + self._reference_size};"
        if self._contact_emitter is not None:
            yield f"    h.reference = memory + {size + self._scratch}, h.has_masks = {str(adjoint).lower()};"
            stored = "all" if adjoint else "(keeps ? substeps : 2)"
            stride = f"(Count({stored}) * {self.mask_size} + 1)"
            yield f"    h.keeps = {'true' if adjoint else 'keeps'};"
            yield f"    h.masks = masks + scene * {stride}, h.all = {'all' if adjoint else 'substeps'};"
            yield from self._contact_emitter.places()
        if adjoint:
            for k, place in inner.items():
                yield f"    h.g{k} = states + (substeps + 2) * {self.state_size} + {2 * self.state_size + place};"
            for k, f in self.fields_of(FieldKind.PARAMETER):
                yield f"    h.g{k} = ports[{k}].gradient ? ports[{k}].gradient + scene * {f.size} : nullptr;"
            for place in self.accumulated.values():
                yield f"    h.sums[{place}] = R(0);"

    def _point_to_inputs(self, row: str, adjoint: bool) -> Iterator[str]:
        """Let the inputs per substep point to a row."""
        for k, f in self.fields_of(FieldKind.PER_SUBSTEP):
            yield f"        h.f{k} = ports[{k}].value + scene * ports[{k}].stride + {row} * {f.comps};"
            if adjoint:
                at = f"(scene * all + {row}) * {f.comps}"
                yield f"        h.g{k} = ports[{k}].gradient ? ports[{k}].gradient + {at} : nullptr;"

    def _point_to_states(self, now: str, after: str, letter: str = "f") -> Iterator[str]:
        """Let the states point to two records; ``letter``: f for values, g for adjoints."""
        for k, place in self.places_of(FieldKind.STATE)[0].items():
            yield f"        h.{letter}{k} = {now} + {place}, h.{letter}{self.program.next[k]} = {after} + {place};"

    def _load_states(self) -> Iterator[str]:
        """Copy the first state."""
        for k, place in self.places_of(FieldKind.STATE)[0].items():
            count = self.fields[k].size
            yield f"    copy(states + {place}, ports[{k}].value + scene * ports[{k}].stride, {count});"

    def _substep(self, number: str) -> Iterator[str]:
        if self._contact_emitter is not None:
            yield f"        h.step = {number};"
        fields = self.fields_to_clear()
        for k in fields:
            yield f"        clear(h.f{k}, {self.fields[k].size});"
        if fields:
            yield "        SYNC();"
        for k in range(len(self.program.stages)):
            yield f"        stage{k}(h);"

    def _values(self) -> Iterator[str]:
        size = self.state_size
        places = self.places_of(FieldKind.STATE)[0]
        sums = self.fields_of(FieldKind.SUM)
        yield f"KERNEL values({KERNEL_PARAMETERS},"
        yield "              const Count* ends, int substeps, int frames, int keeps) {"
        yield from self._set_up(adjoint=False)
        yield from self._load_states()
        for k, f in sums:
            yield f"    clear(h.f{k}, {f.size});"
        yield "    SYNC();"
        yield f"    R *now = states, *after = states + {size};"
        yield "    for (int k = 0, frame = 0; k < substeps; k++) {"
        yield from self._point_to_states("now", "after")
        yield from self._point_to_inputs("k", adjoint=False)
        yield from self._substep("k")
        yield "        R* swapped = now; now = after, after = swapped;"
        yield "        if (k + 1 != ends[frame]) continue;"
        for k, place in places.items():
            f = self.fields[k]
            to = f"ports[{self.program.next[k]}].result + (scene * frames + frame) * {f.size}"
            yield f"        copy({to}, now + {place}, {f.size});"
        for k, f in sums:
            yield f"        copy(ports[{k}].result + (scene * frames + frame) * {f.size}, h.f{k}, {f.size});"
        yield "        SYNC();"
        for k, f in sums:
            yield f"        clear(h.f{k}, {f.size});"
        yield "        SYNC();"
        yield "        frame++;"
        yield "    }"
        if self._contact_emitter is not None:  # whether there was no room for nodes
            yield f"    if (T == 0) h.masks[Count(keeps ? substeps : 2) * {self.mask_size}] = h.nodes.totals[3];"
        yield "}"

    def _adjoint(self) -> Iterator[str]:
        size, last = self.state_size, len(self.program.stages) - 1
        states, sums = self.places_of(FieldKind.STATE)[0], self.fields_of(FieldKind.SUM)
        yield "// From the seeds after the last of some substeps, out of `all`, to the gradients before the first."
        yield f"KERNEL adjoint({KERNEL_PARAMETERS},"
        yield "               int substeps, int first, int all) {"
        yield from self._set_up(adjoint=True)
        yield from self._load_states()
        yield f"    R *seed = states + (substeps + 2) * {size}, *result = seed + {size};"
        for k, place in states.items():
            count = self.fields[k].size
            yield f"    copy(seed + {place}, ports[{self.program.next[k]}].seed + scene * {count}, {count});"
        for k, f in sums:
            yield f"    copy(h.g{k}, ports[{k}].seed + scene * {f.size}, {f.size}), clear(h.f{k}, {f.size});"
        yield "    SYNC();"
        yield "    for (int step = 0; step < 2 * substeps - 1; step++) {"
        yield "        const bool is_forward = step < substeps - 1;  // on the way to the last state but one"
        yield "        const int k = is_forward ? step : 2 * substeps - 2 - step;"
        yield f"        R* now = states + k * {size};"
        yield from self._point_to_states("now", f"(now + {size})")
        yield from self._point_to_inputs("(first + k)", adjoint=True)
        yield from self._substep("first + k")
        yield "        if (is_forward) continue;"
        for k, f in self.fields_of(*WITHIN_SUBSTEP):
            if k in self.with_adjoint:
                yield f"        clear(h.g{k}, {f.size});"
        if self._contact_emitter is not None:
            points = [(k, f) for k, f in self.fields_of(FieldKind.POINTS) if k in self.with_adjoint]
            yield "        if (h.some) " + ", ".join(f"clear(h.g{k}, {f.size})" for k, f in points) + ";"
            yield from self._contact_emitter.clear_node_adjoints()
        yield f"        clear(result, {size});"
        yield from self._point_to_states("result", "seed", "g")
        yield "        SYNC();"
        for k in range(last, -1, -1):
            yield f"        back{k}(h);"
        yield "        R* swapped = seed; seed = result, result = swapped;"
        yield "    }"
        for k, place in states.items():
            count = self.fields[k].size
            yield f"    if (ports[{k}].gradient) copy(ports[{k}].gradient + scene * {count}, seed + {place}, {count});"
        if self.accumulated:
            self.reserve(shared=len(self.accumulated))
            yield f"    reduce(h.sums, {len(self.accumulated)}, h.shared);"
            yield "    if (T != 0) return;"
            for (k, c), place in self.accumulated.items():
                yield f"    if (h.g{k}) h.g{k}[{c}] += h.shared[{place}];"
        yield "}"


_EMITTERS: dict[type, Any] = {
    Loop: LoopEmitter,
    Stencil: StencilEmitter,
    ContactSearch: ContactSearchEmitter,
    GridVelocity: GridVelocityEmitter,
}
