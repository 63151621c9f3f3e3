"""Programs of the engine: what one substep does, as stages that run one after the other on fields of numbers.

A program is written down first and handed to the engine by ``ready``, unless the engine has the same one already: the
programs of two calls are the same where every constant, index and instruction is, so nothing that a user changes in
the parts can be missed, and nothing is built twice.
"""

from __future__ import annotations

import ctypes
import hashlib
import marshal
import os
from collections import OrderedDict
from collections.abc import Callable
from functools import cached_property
from itertools import count
from threading import Lock
from typing import Any
from weakref import WeakValueDictionary

import numpy as np
import torch
from numpy.typing import ArrayLike

from .constants import array
from .fields import Field, Kind
from .library import library
from .loops import OWN, Loop
from .stages import Layers, PerMass, PointTables, Shape, Sieve, Stencil


class Program:
    """What one substep does, for cloths of one structure and precision."""

    def __init__(self, dtype: torch.dtype, vertices: int) -> None:
        self.dtype, self.vertices = dtype, vertices
        self.number = -1  # by which the operators know it; there is none before it is ready
        self._letter = "d" if dtype == torch.float64 else "f"
        self._numpy = np.float64 if dtype == torch.float64 else np.float32
        self._handle: ctypes.c_void_p | None = None
        self.fields: list[Field] = []
        self._constants: dict[bytes, Field] = {}
        self._tables: dict[bytes, int] = {}
        self._reach: list[int] = []  # of each table: rows that it needs
        self._stages: list[Loop | Stencil | Sieve | Layers | PerMass] = []
        self._lists = 0
        self._written: list[tuple[str, tuple]] = []
        self.written: list[tuple[str, tuple]] = []  # names and arguments, of a program that keeps them: see ``ready``

    def __del__(self) -> None:
        # there is no handle where ``__init__`` was not run, and no library when Python ends
        if getattr(self, "_handle", None) is not None and library is not None:
            self._call("free")

    # -- fields ---------------------------------------------------------------------------------------------------

    def constant(self, values: ArrayLike | torch.Tensor, near: int = 0) -> Field:
        """Numbers [rows, comps] that never change; ``near``: the weights [count near V, 1] of a stencil."""
        data = np.ascontiguousarray(array(values), dtype=self._numpy)
        key = data.tobytes() + f"{near} {data.shape}".encode()
        if key not in self._constants:
            self._constants[key] = self._field(Kind.CONSTANT, data.shape[0], data.shape[1], near, data)
        return self._constants[key]

    def parameter(self, rows: int, comps: int, near: int = 0) -> Field:
        """An input with a derivative; ``near``: as for ``constant``."""
        return self._field(Kind.PARAMETER, rows, comps, near)

    def state(self, rows: int, comps: int) -> tuple[Field, Field]:
        """(what is carried, where it goes at the end of the substep)."""
        now, after = self._field(Kind.STATE, rows, comps), self._field(Kind.NEXT, rows, comps)
        self._api("pair")(self._handle, now.id, after.id)
        return now, after

    def temporary(self, rows: int, comps: int, kept: bool = True) -> Field:
        """Zero at the start of a substep; ``kept``: loops read it, so the reverse sweep must know it."""
        return self._field(Kind.KEPT if kept else Kind.TEMPORARY, rows, comps)

    def drive(self, comps: int) -> Field:
        """An input with one row for every substep."""
        return self._field(Kind.DRIVE, 1, comps)

    def sum(self, comps: int) -> Field:
        """Added up over the substeps before a result."""
        return self._field(Kind.SUM, 1, comps)

    def nodes(self) -> Field:
        """Of contact, which sees to its memory: mass and a vector of the nodes that are touched."""
        return self._field(Kind.NODES, 0, 4)

    def points(self, comps: int) -> Field:
        """What varying loops over points tell each other; put once in a substep."""
        return self._field(Kind.POINTS, 0, comps)

    def table(self, index: np.ndarray | torch.Tensor) -> int:
        """Rows to gather from or scatter to, one per item."""
        data = np.ascontiguousarray(array(index), dtype=np.int32).ravel()
        key = data.tobytes()
        if data.min(initial=0) < 0:
            raise ValueError(f"rows {data.min()}: negative")
        if key not in self._tables:
            self._tables[key] = len(self._tables)
            self._reach.append(int(data.max(initial=-1)) + 1)
            self._api("table")(self._handle, data, len(data))
        return self._tables[key]

    def _field(self, kind: Kind, rows: int, comps: int, near: int = 0, data: np.ndarray | None = None) -> Field:
        field = Field(len(self.fields), rows, comps, kind)
        self._api("field")(self._handle, int(kind), rows, comps, near, self.vertices, data)
        self.fields.append(field)
        return field

    # -- stages ---------------------------------------------------------------------------------------------------

    def loop(self, items: int, order: np.ndarray | None = None, flat: bool = False) -> Loop:
        """Runs after all stages that are there already.

        Args:
            items: rows.
            order: in which they are gone through.
            flat: what it gives has no derivative.
        """
        self._stages.append(Loop(items, self._reach, OWN if order is None else self.table(order), flat=flat))
        return self._stages[-1]  # type: ignore[return-value]

    def first(self) -> Loop:
        """Runs before all stages that are there already, once."""
        self._stages.insert(0, Loop(1, self._reach))
        return self._stages[0]  # type: ignore[return-value]

    def among(self, near: int, flat: bool = False) -> Loop:
        """On those points alone that a sieve has found; ``flat`` as for ``loop``."""
        self._stages.append(Loop(0, self._reach, among=near, flat=flat))
        return self._stages[-1]  # type: ignore[return-value]

    def varying(self, count: int, again: bool = False) -> Loop:
        """A loop over what contact finds, number ``count``; ``again``: it writes what is not recorded, and is read."""
        self._stages.append(Loop(0, self._reach, counted=count, again=again))
        return self._stages[-1]  # type: ignore[return-value]

    def contact(self, layers: Layers) -> None:
        """Find at every substep what the varying loops run over."""
        self._stages.append(layers)

    def per_mass(self, mass: Field, given: Field, out: Field, least: float) -> None:
        """out = given / mass on the nodes, where the mass is more than ``least``; see ``csrc/per_mass.h``."""
        self._stages.append(PerMass(mass, given, out, least))

    def sieve(self, x: Field, reach: Field, dt: Field, points: PointTables, steep: float) -> int:
        """A list of the points on triangles that may touch a body in this substep; see ``csrc/sieve.h``.

        Args:
            x: [V, 3] positions.
            reach: [V, 2] distances of the vertices to the body and speeds relative to it.
            dt: substep.
            points: of the triangles.
            steep: how much the distance may change along a way of length 1.
        """
        self._lists += 1
        self._stages.append(Sieve(self._lists - 1, x, reach, dt, points, steep))
        return self._lists - 1

    def stencil(self, near: np.ndarray, weight: Field, x: Field, y: Field, shape: Shape = Shape.PLAIN) -> None:
        """y += differences of x over ``near`` [N, V] with weights [count, N, V]; transposed: x -= transpose of y."""
        self._stages.append(Stencil(self.table(near), weight, x, y, shape))

    def ready(self, keep: bool = False) -> Program:
        """The program to run: an earlier one where there is the same, else this one, handed to the engine.

        ``keep``: what was written down, for another compiler.
        """
        for stage in self._stages:
            stage.emit(self._handle, self._api)
        key = self._key()
        with _KEEPING:  # nobody may run a program that another thread is still handing over
            known = _KEPT.get(key)
            if known is None:
                self._hand_over()  # what is interrupted is not kept: it would pass for the whole
                _KEPT[key] = known = self
                while len(_KEPT) > MOST_KEPT:
                    _KEPT.popitem(last=False)
            _KEPT.move_to_end(key)
        if keep and not known.written:
            known.written = self._written
        self._written = []
        return known

    @cached_property
    def inputs(self) -> list[Field]:
        """States, parameters and drives, in the order in which the operators take them."""
        return [f for f in self.fields if f.kind in (Kind.STATE, Kind.PARAMETER, Kind.DRIVE)]

    @cached_property
    def outputs(self) -> list[Field]:
        """Nexts and sums, in the order in which the operators give them."""
        return [f for f in self.fields if f.kind in (Kind.NEXT, Kind.SUM)]

    def record_size(self, full: bool) -> int:
        """Numbers of a record: of the state alone, or of all that the reverse sweep reads."""
        return self._call("size", int(full))

    def records_size(self, substeps: int, every: int) -> int:
        """Numbers of all records of a scene, with what contact notes."""
        return self._call("records", substeps, every)

    def run(self, call, mode: int) -> None:
        """0: values, 1: adjoint, 2: tangents."""
        _check(self._call("run", ctypes.byref(call), mode))

    def _api(self, name: str) -> Callable[..., int]:
        """Stands for a function of the library: what it is called with (numbers and arrays) is written down."""

        def write(handle: Any, *arguments) -> int:
            self._written.append((name, arguments))
            return 0

        return write

    def _key(self) -> bytes:
        """All that was written down, arrays included; version 0 of marshal knows no references between objects."""
        return hashlib.sha256(self._letter.encode() + marshal.dumps(self._written, 0)).digest()

    def _hand_over(self) -> None:
        self._handle = ctypes.c_void_p(getattr(library(), f"tc_new_{self._letter}")())
        _check(not self._handle)
        for name, arguments in self._written:
            done = self._call(name, *(_for_c(a) for a in arguments))
            _check(done < 0 if name in ("field", "table") else done)  # these give a number
        _check(self._call("ready"))
        self.number = next(_NUMBERS)
        _KNOWN[self.number] = self

    def _call(self, name: str, *arguments) -> Any:
        return getattr(library(), f"tc_{name}_{self._letter}")(self._handle, *arguments)


MOST_KEPT = 64  # programs that wait for the next call, besides those that are in use
_KEPT: OrderedDict[bytes, Program] = OrderedDict()
_KNOWN: WeakValueDictionary[int, Program] = WeakValueDictionary()
_NUMBERS = count()
_KEEPING = Lock()


def _after_fork() -> None:
    """Another thread of the parent may have held it, and is not here to let go."""
    global _KEEPING
    _KEEPING = Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


def _for_c(value: Any) -> Any:
    """Arrays by their memory, tuples as arrays of int."""
    if isinstance(value, np.ndarray):
        return value.ctypes.data
    return (ctypes.c_int * len(value))(*value) if isinstance(value, tuple) else value


def program_of(number: int) -> Program:
    """The program that an operator was given by its number.

    Raises:
        KeyError: nobody holds it any more.
    """
    return _KNOWN[number]


def _check(code: int) -> None:
    if code:
        raise RuntimeError(library().tc_error().decode())
