"""The engine's kernels as straight lines of C++: values, and their adjoints.

``csrc/tape.h`` writes a kernel's operations down at compile time; the library gives them as numbers.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator, Sequence
from functools import cache
from typing import NamedTuple

from ..library import kernels, library

# as in csrc/tape.h
OPERATIONS = (
    *("input", "constant", "add", "sub", "mul", "div", "addc", "rsubc", "mulc", "rdivc", "neg", "sqrt", "exp", "expm1"),
    *("atan2", "abs", "at_least", "at_most", "less", "lessc", "cless", "select", "detach"),
)
VALUES = {
    "add": "{a} + {b}",
    "sub": "{a} - {b}",
    "mul": "{a} * {b}",
    "div": "{a} / {b}",
    "addc": "{a} + {value}",
    "rsubc": "{value} - {a}",
    "mulc": "{a} * {value}",
    "rdivc": "{value} / {a}",
    "neg": "-{a}",
    "sqrt": "sqrt({a})",
    "exp": "exp({a})",
    "expm1": "expm1({a})",
    "atan2": "atan2({a}, {b})",
    "abs": "({a} < R(0) ? -{a} : {a})",
    "at_least": "({a} < {value} ? {value} : {a})",
    "at_most": "({value} < {a} ? {value} : {a})",
    "less": "R({a} < {b})",
    "lessc": "R({a} < {value})",
    "cless": "R({value} < {a})",
    "select": "({c} != R(0) ? {a} : {b})",
    "detach": "{a}",
    "constant": "{value}",
}
# adjoints of the first and the second operand, from that of the operation, {g}; {own} is its value
FIRST = {
    "add": "{g}",
    "sub": "{g}",
    "addc": "{g}",
    "mul": "{g} * {b}",
    "div": "{g} / {b}",
    "rsubc": "-{g}",
    "neg": "-{g}",
    "mulc": "{g} * {value}",
    "rdivc": "-({g} * ({own} / {a}))",
    "sqrt": "{g} * (R(0.5) / {own})",
    "exp": "{g} * {own}",
    "expm1": "{g} * ({own} + R(1))",
    "atan2": "{g} * ({b} / ({a} * {a} + {b} * {b}))",
    "abs": "(R(0) < {a} ? {g} : {a} < R(0) ? -{g} : R(0))",
    "at_least": "({a} < {value} ? R(0) : {g})",
    "at_most": "({value} < {a} ? R(0) : {g})",
    "select": "({c} != R(0) ? {g} : R(0))",
}
SECOND = {
    "add": "{g}",
    "sub": "-{g}",
    "mul": "{g} * {a}",
    "div": "-({g} * ({own} / {b}))",
    "atan2": "-({g} * ({a} / ({a} * {a} + {b} * {b})))",
    "select": "({c} != R(0) ? R(0) : {g})",
}


class Operation(NamedTuple):
    """One of a kernel; operands are numbers of earlier ones, or -1. Of an input, ``a`` is which."""

    name: str
    a: int
    b: int
    c: int
    varies: bool  # it has a derivative
    value: float


class Kernel(NamedTuple):
    """All of them, and which are the results."""

    operations: tuple[Operation, ...]
    out: tuple[int, ...]

    def values(self, own: str, inputs: Sequence[str]) -> Iterator[str]:
        """Lines that define ``own``0, ``own``1, ... from expressions for the inputs."""
        for i, o in enumerate(self.operations):
            found = inputs[o.a] if o.name == "input" else VALUES[o.name].format(**self._names(own, i))
            yield f"const R {own}{i} = {found};"

    def adjoints(self, own: str, seeds: Sequence[str], inputs: Sequence[str]) -> Iterator[str]:
        """Lines behind ``values`` that add to the adjoints of the inputs, from those of the results."""
        there: set[int] = set()  # operations that have an adjoint already

        def give(to: int, what: str) -> str:
            begins = "R " if to not in there else ""
            there.add(to)
            return f"{begins}{own}g{to} {'=' if begins else '+='} {what};"

        for to, seed in zip(self.out, seeds, strict=True):
            yield give(to, seed)
        for i in reversed(range(len(self.operations))):
            o = self.operations[i]
            if i not in there or not o.varies:
                continue
            if o.name == "input":
                yield f"{inputs[o.a]} += {own}g{i};"
                continue
            names = self._names(own, i) | {"g": f"{own}g{i}", "own": f"{own}{i}"}
            for operand, share in ((o.a, FIRST), (o.b, SECOND)):
                if operand >= 0 and self.operations[operand].varies:
                    yield give(operand, share[o.name].format(**names))

    def _names(self, own: str, i: int) -> dict[str, str]:
        o = self.operations[i]
        return {"a": f"{own}{o.a}", "b": f"{own}{o.b}", "c": f"{own}{o.c}", "value": number(o.value)}


def number(value: float) -> str:
    """In C++, in the program's precision."""
    return f"R({value!r})"


@cache
def kernel(which: int) -> Kernel:
    """By the engine's number."""
    lib = library()
    _, _, gives = next(found for found in kernels().values() if found[0] == which)
    size = lib.tc_kernel_size(which)
    operations, values, out = (ctypes.c_int * (5 * size))(), (ctypes.c_double * size)(), (ctypes.c_int * gives)()
    lib.tc_kernel_listing(which, operations, values, out)
    rows = zip(*(operations[k::5] for k in range(5)), values, strict=True)
    return Kernel(tuple(Operation(OPERATIONS[op], a, b, c, bool(v), x) for op, a, b, c, v, x in rows), tuple(out))
