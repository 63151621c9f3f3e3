"""Programs of the engine: which numbers a substep reads, which kernels it runs, and where results go.

    loop = program.loop(triangles)
    x0, x1, x2 = (loop.load(x, at=corner) for corner in corners)
    *f, n, J = loop.call("surface", x0, x1, x2, ...)

A loop's registers are numbered once and for all; a list of them stands for a vector.

A program is written down first and handed to the engine by ``ready``, unless the engine has the same one already: the
programs of two calls are the same where every constant, index and instruction is, so nothing that a user changes in
the parts can be missed, and nothing is built twice.
"""

from __future__ import annotations

import ctypes
import hashlib
from collections import OrderedDict
from collections.abc import Callable, Sequence
from enum import IntEnum
from itertools import count
from typing import Any, NamedTuple
from weakref import WeakValueDictionary

import numpy as np
import torch
from numpy.typing import ArrayLike

from .library import kernels, library
from .wrapped import array

OWN, SHARED, VARYING = -1, -2, -3
LOAD, ADD, PUT, SPREAD, COLLECT = 0, 2, 3, 5, 6
SHARES = 16  # numbers of a point, see csrc/transfer.h


class Kind(IntEnum):
    """What a field is; as in csrc/program.h."""

    CONSTANT, PARAMETER, STATE, NEXT, TEMPORARY, KEPT, DRIVE, SUM, NODES, POINTS = range(10)


class Shape(IntEnum):
    """Of a stencil's operator; as in csrc/stencil.h."""

    PLAIN, TRANSPOSED, SYMMETRIC = range(3)


class By(IntEnum):
    """What nodes get from points, and points from nodes, besides by weight; as in csrc/transfer.h."""

    SLOPES, ARMS = range(2)


class Field(NamedTuple):
    """Rows of numbers, by the engine's number."""

    id: int
    rows: int
    comps: int
    kind: Kind


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
        self._stages: list[Loop | Stencil | Sieve | Layers] = []
        self._lists = 0
        self._written: list[tuple[str, tuple]] = []

    def __del__(self) -> None:
        if self._handle is not None:
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
        """Added up over all substeps."""
        return self._field(Kind.SUM, 1, comps)

    def nodes(self, comps: int) -> Field:
        """Of contact, which sees to its memory: numbers of the nodes that are touched, or of the points."""
        return self._field(Kind.NODES, 0, comps)

    def points(self, comps: int) -> Field:
        """What varying loops over points tell each other; put once in a substep."""
        return self._field(Kind.POINTS, 0, comps)

    def table(self, index: np.ndarray | torch.Tensor) -> int:
        """Rows to gather from or scatter to, one per item."""
        data = np.ascontiguousarray(array(index), dtype=np.int32).ravel()
        key = data.tobytes()
        if key not in self._tables:
            self._tables[key] = len(self._tables)
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
        self._stages.append(Loop(items, OWN if order is None else self.table(order), flat=flat))
        return self._stages[-1]  # type: ignore[return-value]

    def first(self) -> Loop:
        """Runs before all stages that are there already, once."""
        self._stages.insert(0, Loop(1))
        return self._stages[0]  # type: ignore[return-value]

    def among(self, near: int, flat: bool = False) -> Loop:
        """On those points alone that a sieve has found; ``flat`` as for ``loop``."""
        self._stages.append(Loop(0, among=near, flat=flat))
        return self._stages[-1]  # type: ignore[return-value]

    def varying(self, count: int, again: bool = False) -> Loop:
        """A loop over what contact finds, number ``count``; ``again``: it writes what is not recorded, and is read."""
        self._stages.append(Loop(0, counted=count, again=again))
        return self._stages[-1]  # type: ignore[return-value]

    def contact(self, layers: Layers) -> None:
        """Find at every substep what the varying loops run over."""
        self._stages.append(layers)

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

    def ready(self) -> Program:
        """The program to run: an earlier one where there is the same, else this one, handed to the engine."""
        for stage in self._stages:
            stage.emit(self._handle, self._api)
        key = self._key()
        known = _KEPT.setdefault(key, self)
        _KEPT.move_to_end(key)
        if known is self:
            self._hand_over()
            while len(_KEPT) > MOST_KEPT:
                _KEPT.popitem(last=False)
        self._written.clear()
        return known

    @property
    def inputs(self) -> list[Field]:
        """States, parameters and drives, in the order in which the operators take them."""
        return [f for f in self.fields if f.kind in (Kind.STATE, Kind.PARAMETER, Kind.DRIVE)]

    @property
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
        known = hashlib.sha256(self._letter.encode())
        for name, arguments in self._written:
            known.update(name.encode())
            for value in arguments:
                known.update(bytes(value) if isinstance(value, (np.ndarray, ctypes.Array)) else repr(value).encode())
                known.update(b",")
        return known.digest()

    def _hand_over(self) -> None:
        self._handle = ctypes.c_void_p(getattr(library(), f"tc_new_{self._letter}")())
        for name, arguments in self._written:
            done = self._call(name, *(a.ctypes.data if isinstance(a, np.ndarray) else a for a in arguments))
            if name not in ("field", "table"):  # they give a number
                _check(done or 0)
        self._call("ready")
        self.number = next(_NUMBERS)
        _KNOWN[self.number] = self

    def _call(self, name: str, *arguments) -> Any:
        return getattr(library(), f"tc_{name}_{self._letter}")(self._handle, *arguments)


MOST_KEPT = 64  # programs that wait for the next call, besides those that are in use
_KEPT: OrderedDict[bytes, Program] = OrderedDict()
_KNOWN: WeakValueDictionary[int, Program] = WeakValueDictionary()
_NUMBERS = count()


def program_of(number: int) -> Program:
    """The program that an operator was given by its number.

    Raises:
        KeyError: nobody holds it any more.
    """
    return _KNOWN[number]


class Loop:
    """Instructions on every item."""

    def __init__(
        self, items: int, own: int = OWN, among: int = -1, counted: int = -1, flat: bool = False, again: bool = False
    ) -> None:
        self.items, self._own, self._among, self._counted = items, own, among, counted
        self.flat, self.again = flat, again
        self._used = 0
        self._code: list[tuple] = []
        self._loaded: dict[tuple[int, int], list[int]] = {}

    def load(self, field: Field, at: int | None = None) -> list[int]:
        """Registers with a row of the field: the item's own, the one in table ``at``, or the only one.

        The same registers whenever asked again: no loop reads what it writes.
        """
        place = self._place(field, at)
        if (field.id, place) not in self._loaded:
            regs = self._loaded[field.id, place] = self._new(field.comps)
            self._code.append(("move", LOAD, field.id, place, regs[0]))
        return self._loaded[field.id, place]

    def call(self, kernel: str, *inputs: Sequence[int], into: list[int] | None = None) -> list[int]:
        """Registers with a kernel's results; ``into``: added to these."""
        number, takes, gives = kernels()[kernel]
        flat = [reg for group in inputs for reg in group]
        if len(flat) != takes:
            raise ValueError(f"kernel {kernel!r} takes {takes} numbers, not {len(flat)}")
        out = self._new(gives) if into is None else into
        self._code.append(("call", number, flat, out if into is None else [~reg for reg in out]))
        return out

    def lookup(self, table: Field, nodes: Sequence[int], place: Sequence[int]) -> tuple[list[int], list[int]]:
        """(fractions of the cell, values at its 8 corners) of a place on a grid [x, y, z] in cells."""
        regs = self._new(11)
        self._code.append(("lookup", table.id, *nodes, place[0], regs[0]))
        return regs[:3], regs[3:]

    def add(self, regs: Sequence[int], field: Field, at: int | None = None) -> None:
        """Add registers to a row of the field."""
        self._move(ADD, regs, field, at)

    def put(self, regs: Sequence[int], field: Field, at: int | None = None) -> None:
        """Write registers to a row of the field."""
        self._move(PUT, regs, field, at)

    def spread(self, offset: Sequence[int], share: Sequence[int], field: Field, at: int, by: By) -> None:
        """Add a point's shares to the 27 nodes around it (table ``at``), by its offset from the lowest of them."""
        self._code.append(("transfer", SPREAD, field.id, at, offset[0], share[0], int(by)))

    def collect(self, offset: Sequence[int], field: Field, at: int, by: By) -> list[int]:
        """Shares of a point that are the sums over its nodes."""
        share = self._new(SHARES)
        self._code.append(("transfer", COLLECT, field.id, at, offset[0], share[0], int(by)))
        return share

    def _move(self, code: int, regs: Sequence[int], field: Field, at: int | None) -> None:
        if len(regs) != field.comps or list(regs) != list(range(regs[0], regs[0] + len(regs))):
            raise ValueError(f"{field} cannot take the registers {regs}")
        self._code.append(("move", code, field.id, self._place(field, at), regs[0]))

    def _place(self, field: Field, at: int | None) -> int:
        return SHARED if field.rows == 1 else self._own if at is None else at

    def _new(self, count: int) -> list[int]:
        self._used += count
        return list(range(self._used - count, self._used))

    def emit(self, handle, api) -> None:
        """Write down the instructions."""
        read = self._read()
        api("loop")(handle, self.items, self._among, self._counted, int(self.flat), int(self.again))
        for kind, *rest in self._code:
            if kind in ("move", "lookup"):
                api(kind)(handle, *rest)
            elif kind == "transfer":
                share = rest[4]
                api("transfer")(handle, *rest, int(bool(read & set(range(share, share + SHARES)))))
            else:
                number, takes, gives = rest
                feeds = int(any(reg in read or ~reg in read for reg in gives))
                api("call")(handle, number, _ints(takes), _ints(gives), feeds)

    def _read(self) -> set[int]:
        """Registers whose values the reverse sweep needs."""
        read: set[int] = set()
        for kind, *rest in self._code:
            if kind == "call":
                read.update(rest[1])
            elif kind == "lookup":
                read.update(range(rest[4], rest[4] + 3))
            elif kind == "transfer":
                code, _, _, offset, share, _ = rest
                read.update(range(offset, offset + 3))
                read.update(range(share, share + SHARES) if code == SPREAD else ())
        return read


class Layers(NamedTuple):
    """Contact between layers: which triangles may take part, and the grid; see csrc/contact.h."""

    fields: Sequence[Field]  # positions, lowest node of each point, fields of the nodes
    corners: np.ndarray  # [3, E] int32
    places: np.ndarray  # [S, 3] float64, barycentric
    lengths: tuple[float, float, float]  # spacing, skin, reach [m]
    wrap: int
    chunk: int
    order: np.ndarray  # [E] int32, patch by patch
    starts: np.ndarray  # [patches + 1] int32; [1]: all triangles take part always
    meet: np.ndarray  # [patches, patches] uint8
    apart: np.ndarray  # [E, patches] uint8, a bit for each triangle of a patch

    def emit(self, handle, api) -> None:
        """Write it down."""
        ids = _ints([field.id for field in self.fields])
        limits = _ints([self.wrap, self.chunk, len(self.starts) - 1])
        lengths = (ctypes.c_double * 3)(*self.lengths)
        corners, places = _array(self.corners), _array(self.places)
        search = (_array(a) for a in (self.order, self.starts, self.meet, self.apart))
        sizes = self.corners.shape[1], len(self.places)
        api("contact")(handle, ids, len(ids), corners, sizes[0], places, sizes[1], lengths, limits, *search)


class PointTables(NamedTuple):
    """Points on triangles, in the order of these."""

    corners: int  # table [3, E] of vertices
    starts: int  # table [E + 1] of the first points
    triangles: int


class Sieve(NamedTuple):
    """See ``Program.sieve``."""

    number: int
    x: Field
    reach: Field
    dt: Field
    points: PointTables
    steep: float

    def emit(self, handle, api) -> None:
        """Write it down."""
        fields = (self.x.id, self.reach.id, self.dt.id)
        api("sieve")(handle, self.number, *fields, *self.points, self.steep)


class Stencil(NamedTuple):
    """See ``Program.stencil``."""

    table: int
    weight: Field
    x: Field
    y: Field
    shape: Shape

    def emit(self, handle, api) -> None:
        """Write it down."""
        api("stencil")(handle, self.table, self.weight.id, self.x.id, self.y.id, int(self.shape))


def _ints(values: Sequence[int]):
    return (ctypes.c_int * len(values))(*values)


def _array(values: np.ndarray):
    return np.ctypeslib.as_ctypes(np.ascontiguousarray(values).reshape(-1))


def _check(code: int) -> None:
    if code:
        raise RuntimeError(library().tc_error().decode())
