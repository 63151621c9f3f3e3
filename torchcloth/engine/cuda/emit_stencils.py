"""Stencils of vertices as CUDA C++: a function for values, and one for adjoints."""

from __future__ import annotations

from collections.abc import Iterator

from ..enums import FieldKind, StencilForm
from .layout import Layout
from .program_ir import Stencil


class StencilEmitter:
    """Functions of a stencil: y_c(v) += sum_n w_c(n, v) (x(near(n, v)) - x(v)), and its transposes.

    Args:
        layout: memory of the program.
        stage: the stencil.
        first_written: fields that no earlier stage writes.
    """

    def __init__(self, layout: Layout, stage: Stencil, first_written: set[int]) -> None:
        self._layout, self._stage, self._first_written = layout, stage, first_written
        fields = layout.fields
        self._vertices = fields[stage.x].rows
        self._neighbour_count = fields[stage.weight].neighbours
        self._count = fields[stage.weight].size // self._neighbour_count // self._vertices

    def forward(self) -> Iterator[str]:
        """Yield the lines for values."""
        x, y, transposed = self._stage.x, self._stage.y, self._stage.form == StencilForm.TRANSPOSED
        assign = "=" if (x if transposed else y) in self._first_written else "+="
        if transposed:
            yield from self._apply_transpose(f"h.f{y}", f"h.f{x}", assign, "")
        else:
            yield from self._apply(f"h.f{x}", f"h.f{y}", assign, "")

    def reverse(self) -> Iterator[str]:
        """Yield the lines for adjoints."""
        x, y, form = self._stage.x, self._stage.y, self._stage.form
        if form == StencilForm.TRANSPOSED:
            yield from self._apply(f"h.g{x}", f"h.g{y}", "+=", "-")
            yield from self._weight_gradient(f"h.g{x}", f"h.f{y}", "-")
        else:
            if form == StencilForm.SYMMETRIC:
                yield from self._apply(f"h.g{y}", f"h.g{x}", "+=", "")
            else:
                yield from self._apply_transpose(f"h.g{y}", f"h.g{x}", "+=", "-")
            yield from self._weight_gradient(f"h.f{x}", f"h.g{y}", "")

    def _vertex_loop(self) -> Iterator[str]:
        yield f"for (int v = T; v < {self._vertices}; v += THREADS) {{"

    def _neighbour_loop(self) -> Iterator[str]:
        yield f"    for (int n = 0; n < {self._neighbour_count}; n++) {{"
        table = self._layout.table(self._stage.table)
        yield f"        const int at = n * {self._vertices} + v, o = h.tables[{table} + at];"
        yield "        if (o == v) continue;"

    def _weight(self, c: int, at: str = "at") -> str:
        return f"w[{c * self._neighbour_count * self._vertices} + {at}]"

    def _sums(self, parts: int) -> str:
        return f"    R {', '.join(f'a{k} = R(0)' for k in range(parts))};"

    def _apply(self, source: str, to: str, assign: str, sign: str) -> Iterator[str]:
        yield f"const R *w = h.f{self._stage.weight}, *from = {source};"
        yield f"R* to = {to};"
        yield from self._vertex_loop()
        yield self._sums(3 * self._count)
        yield "    const R x0 = from[3 * v], x1 = from[3 * v + 1], x2 = from[3 * v + 2];"
        yield from self._neighbour_loop()
        yield "        const R d0 = from[3 * o] - x0, d1 = from[3 * o + 1] - x1, d2 = from[3 * o + 2] - x2;"
        for c in range(self._count):
            yield f"        const R w{c} = {self._weight(c)};"
            yield "        " + " ".join(f"a{3 * c + k} += w{c} * d{k};" for k in range(3))
        yield "    }"
        for k in range(3 * self._count):
            yield f"    to[{3 * self._count} * v + {k}] {assign} {sign}a{k};"
        yield "}"
        yield "SYNC();"

    def _apply_transpose(self, source: str, to: str, assign: str, sign: str) -> Iterator[str]:
        """Minus the transpose; ``sign`` "-": the transpose."""
        first, entries = self._layout.inverse_tables(self._stage.table, self._vertices)
        row = 3 * self._count
        yield f"const R *w = h.f{self._stage.weight}, *from = {source};"
        yield f"R* to = {to};"
        yield from self._vertex_loop()
        yield self._sums(3)
        yield f"    R {', '.join(f'centre{c} = R(0)' for c in range(self._count))};"
        yield from self._neighbour_loop()
        yield "        " + " ".join(f"centre{c} += {self._weight(c)};" for c in range(self._count))
        yield "    }"
        for c in range(self._count):
            yield "    " + " ".join(f"a{k} += centre{c} * from[{row} * v + {3 * c + k}];" for k in range(3))
        yield f"    for (int e = h.tables[{first} + v]; e < h.tables[{first} + v + 1]; e++) {{"
        yield f"        const int at = h.tables[{entries} + e], o = at % {self._vertices};"
        for c in range(self._count):
            yield f"        const R w{c} = {self._weight(c)};"
            yield "        " + " ".join(f"a{k} -= w{c} * from[{row} * o + {3 * c + k}];" for k in range(3))
        yield "    }"
        for k in range(3):
            yield f"    to[3 * v + {k}] {assign} {sign}a{k};"
        yield "}"
        yield "SYNC();"

    def _weight_gradient(self, x: str, y: str, sign: str) -> Iterator[str]:
        """The gradient of the weights, where they are an input."""
        weight = self._stage.weight
        if self._layout.fields[weight].kind == FieldKind.CONSTANT:
            return
        row = 3 * self._count
        yield f"if (h.g{weight}) {{"
        yield f"    const R *argument = {x}, *moment = {y};"
        yield from (f"    {line}" for line in self._vertex_loop())
        yield from (f"    {line}" for line in self._neighbour_loop())
        for c in range(self._count):
            dots = " + ".join(
                f"(argument[3 * o + {k}] - argument[3 * v + {k}]) * moment[{row} * v + {3 * c + k}]" for k in range(3)
            )
            yield f"            h.g{weight}[{c * self._neighbour_count * self._vertices} + at] += {sign}({dots});"
        yield "        }"
        yield "    }"
        yield "}"
        yield "SYNC();"
