"""Stencils of vertices as CUDA C++: a function for values, and one for adjoints."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from ..fields import Kind
from ..stages import Shape
from .program_ir import Stencil

if TYPE_CHECKING:
    from .codegen import Source


class OfStencil:
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
        table = self._source.table(self._stage.table)
        yield f"        const int at = n * {self._vertices} + v, o = h.tables[{table} + at];"
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
