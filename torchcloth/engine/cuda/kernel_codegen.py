"""The engine's kernels as straight-line C++: values, and their adjoints.

``csrc/tape.h`` records a kernel's operations at compile time; the library returns them as numbers.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator, Sequence
from functools import cache
from typing import NamedTuple

from ..enums import TapeOp
from ..library import kernels, library

VALUE = {
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
# adjoints of the left and the right operand, from the operation's adjoint {g}; {result} is the operation's value
LEFT_ADJOINT = {
    "add": "{g}",
    "sub": "{g}",
    "addc": "{g}",
    "mul": "{g} * {b}",
    "div": "{g} / {b}",
    "rsubc": "-{g}",
    "neg": "-{g}",
    "mulc": "{g} * {value}",
    "rdivc": "-({g} * ({result} / {a}))",
    "sqrt": "{g} * (R(0.5) / {result})",
    "exp": "{g} * {result}",
    "expm1": "{g} * ({result} + R(1))",
    "atan2": "{g} * ({b} / ({a} * {a} + {b} * {b}))",
    "abs": "(R(0) < {a} ? {g} : {a} < R(0) ? -{g} : R(0))",
    "at_least": "({a} < {value} ? R(0) : {g})",
    "at_most": "({value} < {a} ? R(0) : {g})",
    "select": "({c} != R(0) ? {g} : R(0))",
}
RIGHT_ADJOINT = {
    "add": "{g}",
    "sub": "-{g}",
    "mul": "{g} * {a}",
    "div": "-({g} * ({result} / {b}))",
    "atan2": "-({g} * ({a} / ({a} * {a} + {b} * {b})))",
    "select": "({c} != R(0) ? R(0) : {g})",
}


class Operation(NamedTuple):
    """An operation of a kernel.

    Attributes:
        name: of a ``TapeOp``, in lower case.
        a, b, c: operands, numbers of earlier operations; -1: none. Of an input, ``a`` says which.
        varies: whether it has a derivative.
        value: constant operand.
    """

    name: str
    a: int
    b: int
    c: int
    varies: bool
    value: float


class Kernel(NamedTuple):
    """A kernel.

    Attributes:
        operations: all operations in order.
        out: numbers of the operations that are results.
    """

    operations: tuple[Operation, ...]
    out: tuple[int, ...]

    def values(self, prefix: str, inputs: Sequence[str]) -> Iterator[str]:
        """Yield lines that define ``prefix``0, ``prefix``1, ... from expressions for the inputs."""
        for i, o in enumerate(self.operations):
            expression = inputs[o.a] if o.name == "input" else VALUE[o.name].format(**self._names(prefix, i))
            yield f"const R {prefix}{i} = {expression};"

    def adjoints(self, prefix: str, seeds: Sequence[str], inputs: Sequence[str]) -> Iterator[str]:
        """Yield lines that follow ``values`` and add to the adjoints of the inputs, from those of the results."""
        assigned: set[int] = set()  # operations that have an adjoint already

        def accumulate(to: int, what: str) -> str:
            declaration = "R " if to not in assigned else ""
            assigned.add(to)
            return f"{declaration}{prefix}g{to} {'=' if declaration else '+='} {what};"

        for to, seed in zip(self.out, seeds, strict=True):
            yield accumulate(to, seed)
        for i in reversed(range(len(self.operations))):
            o = self.operations[i]
            if i not in assigned or not o.varies:
                continue
            if o.name == "input":
                yield f"{inputs[o.a]} += {prefix}g{i};"
                continue
            names = self._names(prefix, i) | {"g": f"{prefix}g{i}", "result": f"{prefix}{i}"}
            for operand, adjoint in ((o.a, LEFT_ADJOINT), (o.b, RIGHT_ADJOINT)):
                if operand >= 0 and self.operations[operand].varies:
                    yield accumulate(operand, adjoint[o.name].format(**names))

    def _names(self, prefix: str, i: int) -> dict[str, str]:
        o = self.operations[i]
        names = {"a": f"{prefix}{o.a}", "b": f"{prefix}{o.b}", "c": f"{prefix}{o.c}"}
        return names | {"value": cpp_number(o.value)}


def cpp_number(value: float) -> str:
    """Return a number as C++ in the program's precision."""
    return f"R({value!r})"


@cache
def kernel(number: int) -> Kernel:
    """Return a kernel by the engine's number."""
    lib = library()
    _, _, outputs = next(info for info in kernels().values() if info[0] == number)
    size = lib.tc_kernel_size(number)
    codes, values, out = (ctypes.c_int * (5 * size))(), (ctypes.c_double * size)(), (ctypes.c_int * outputs)()
    lib.tc_kernel_listing(number, codes, values, out)
    rows = zip(*(codes[k::5] for k in range(5)), values, strict=True)
    operations = (Operation(TapeOp(op).name.lower(), a, b, c, bool(v), x) for op, a, b, c, v, x in rows)
    return Kernel(tuple(operations), tuple(out))
