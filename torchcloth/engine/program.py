"""Programs of the engine: what one substep does, as stages that run one after the other on fields of numbers.

A program is recorded first. ``finish`` then hands it to the engine, unless the engine has an identical one already. Two
programs are identical if every constant, index and instruction is. So no change that a user makes to the parts can be
missed, and no program is built twice.
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

from .enums import ITEM_ROW, ContactCount, FieldKind, RunMode, StencilForm
from .fields import Field
from .host_arrays import to_numpy
from .library import library
from .loops import Loop
from .stages import ContactSearch, GridVelocity, PointBroadPhase, PointTables, Stencil

MAX_CACHED_PROGRAMS = 64  # programs that wait for the next call, besides those in use


class Program:
    """What one substep does, for cloths of one structure and precision.

    Args:
        dtype: precision.
        vertices: vertices of the mesh.
    """

    def __init__(self, dtype: torch.dtype, vertices: int) -> None:
        self.dtype, self.vertices = dtype, vertices
        self.number = -1  # by which the operators know it, from ``finish`` on
        self._suffix = "d" if dtype == torch.float64 else "f"
        self._numpy = np.float64 if dtype == torch.float64 else np.float32
        self._handle: ctypes.c_void_p | None = None
        self.fields: list[Field] = []
        self._constants: dict[bytes, Field] = {}
        self._tables: dict[bytes, int] = {}
        self._table_rows: list[int] = []  # rows that each table needs
        self._stages: list[Loop | Stencil | PointBroadPhase | ContactSearch | GridVelocity] = []
        self._point_lists = 0
        self._calls: list[tuple[str, tuple]] = []
        self.recorded_calls: list[tuple[str, tuple]] = []  # names and arguments, where ``finish`` was asked for them

    def __del__(self) -> None:
        # there is no handle where ``__init__`` was not run, and no library when Python ends
        if getattr(self, "_handle", None) is not None and library is not None:
            self._call("free")

    # -- fields ---------------------------------------------------------------------------------------------------

    def constant(self, values: ArrayLike | torch.Tensor, neighbours: int = 0) -> Field:
        """Return a field of numbers [rows, comps] that never change.

        ``neighbours``: N of the weights [count N V, 1] of a stencil, else 0.
        """
        data = np.ascontiguousarray(to_numpy(values), dtype=self._numpy)
        key = data.tobytes() + f"{neighbours} {data.shape}".encode()
        if key not in self._constants:
            rows, comps = data.shape
            self._constants[key] = self._field(FieldKind.CONSTANT, rows, comps, neighbours, data)
        return self._constants[key]

    def parameter(self, rows: int, comps: int, neighbours: int = 0) -> Field:
        """Return a field for an input with a derivative; ``neighbours`` as for ``constant``."""
        return self._field(FieldKind.PARAMETER, rows, comps, neighbours)

    def state(self, rows: int, comps: int) -> tuple[Field, Field]:
        """Return the fields of a state variable at the start and at the end of the substep."""
        start, end = self._field(FieldKind.STATE, rows, comps), self._field(FieldKind.NEXT, rows, comps)
        self._api("next_state")(self._handle, start.id, end.id)
        return start, end

    def temporary(self, rows: int, comps: int, is_recorded: bool = True) -> Field:
        """Return a field that is zero at the start of a substep.

        ``is_recorded``: loops read it, so the reverse sweep must know it.
        """
        return self._field(FieldKind.RECORDED if is_recorded else FieldKind.TEMPORARY, rows, comps)

    def per_substep(self, comps: int) -> Field:
        """Return a field for an input with one row for every substep."""
        return self._field(FieldKind.PER_SUBSTEP, 1, comps)

    def sum(self, comps: int) -> Field:
        """Return a field that is summed over the substeps before a result."""
        return self._field(FieldKind.SUM, 1, comps)

    def nodes(self) -> Field:
        """Return a field with mass and a vector of each active node; the contact search sizes it."""
        return self._field(FieldKind.NODES, 0, 4)

    def points(self, comps: int) -> Field:
        """Return a field that loops over contact points hand to each other; it is stored once in a substep."""
        return self._field(FieldKind.POINTS, 0, comps)

    def table(self, index: np.ndarray | torch.Tensor) -> int:
        """Return the number of a table of rows to gather from or scatter to, one row per item.

        Raises:
            ValueError: a row is negative.
        """
        data = np.ascontiguousarray(to_numpy(index), dtype=np.int32).ravel()
        key = data.tobytes()
        if data.min(initial=0) < 0:
            raise ValueError(f"rows {data.min()}: negative")
        if key not in self._tables:
            self._tables[key] = len(self._tables)
            self._table_rows.append(int(data.max(initial=-1)) + 1)
            self._api("table")(self._handle, data, len(data))
        return self._tables[key]

    def _field(
        self, kind: FieldKind, rows: int, comps: int, neighbours: int = 0, data: np.ndarray | None = None
    ) -> Field:
        field = Field(len(self.fields), rows, comps, kind)
        self._api("field")(self._handle, int(kind), rows, comps, neighbours, self.vertices, data)
        self.fields.append(field)
        return field

    # -- stages ---------------------------------------------------------------------------------------------------

    def loop(self, items: int, order: np.ndarray | None = None, no_derivative: bool = False) -> Loop:
        """Append a loop, which runs after all present stages.

        Args:
            items: items of the loop.
            order: [items] order in which they are visited.
            no_derivative: results have no derivative.
        """
        item_table = ITEM_ROW if order is None else self.table(order)
        self._stages.append(Loop(items, self._table_rows, item_table, no_derivative=no_derivative))
        return self._stages[-1]  # type: ignore[return-value]

    def setup_loop(self) -> Loop:
        """Insert a loop of one item that runs before all present stages."""
        self._stages.insert(0, Loop(1, self._table_rows))
        return self._stages[0]  # type: ignore[return-value]

    def loop_over_points(self, point_list: int, no_derivative: bool = False) -> Loop:
        """Append a loop over the points that a broad phase lists; ``no_derivative`` as for ``loop``."""
        self._stages.append(Loop(0, self._table_rows, point_list=point_list, no_derivative=no_derivative))
        return self._stages[-1]  # type: ignore[return-value]

    def loop_over_contact(self, points: ContactCount, is_replayed: bool = False) -> Loop:
        """Append a loop over points that the contact search lists; ``is_replayed`` as for ``Loop``."""
        self._stages.append(Loop(0, self._table_rows, contact_count=points, is_replayed=is_replayed))
        return self._stages[-1]  # type: ignore[return-value]

    def contact_search(self, search: ContactSearch) -> None:
        """Append the search that lists contact points at every substep."""
        self._stages.append(search)

    def grid_velocity(self, mass: Field, momentum: Field, velocity: Field, min_mass: float) -> None:
        """Append velocity = momentum / mass on the nodes where the mass exceeds ``min_mass`` [kg].

        See ``csrc/grid_momentum_to_velocity.h``.
        """
        self._stages.append(GridVelocity(mass, momentum, velocity, min_mass))

    def broad_phase(self, x: Field, approach: Field, dt: Field, points: PointTables, lipschitz: float) -> int:
        """Append a broad phase; return the number of its list of points that may touch a body in this substep.

        See ``csrc/broad_phase.h``.

        Args:
            x: [V, 3] positions [m].
            approach: [V, 2] distances of the vertices to the body [m] and speeds relative to it [m/s].
            dt: substep [s].
            points: tables of the sample points.
            lipschitz: Lipschitz constant of the body's distance function.
        """
        self._point_lists += 1
        self._stages.append(PointBroadPhase(self._point_lists - 1, x, approach, dt, points, lipschitz))
        return self._point_lists - 1

    def stencil(
        self, near: np.ndarray, weight: Field, x: Field, y: Field, form: StencilForm = StencilForm.PLAIN
    ) -> None:
        """Append y += weighted differences of x over the neighbours ``near`` [N, V]; weights are [count, N, V].

        The transposed form subtracts the transpose of y from x.
        """
        self._stages.append(Stencil(self.table(near), weight, x, y, form))

    def finish(self, keep_calls: bool = False) -> Program:
        """Return the program to run: an identical earlier one, else this one after handing it to the engine.

        ``keep_calls``: keep the recorded calls, for another compiler.
        """
        for stage in self._stages:
            stage.emit(self._handle, self._api)
        key = self._key()
        with _cache_lock:  # nobody may run a program that another thread is still handing over
            program = _cache.get(key)
            if program is None:
                self._hand_over()  # an interrupted program is not cached: it would pass for the whole one
                _cache[key] = program = self
                while len(_cache) > MAX_CACHED_PROGRAMS:
                    _cache.popitem(last=False)
            _cache.move_to_end(key)
        if keep_calls and not program.recorded_calls:
            program.recorded_calls = self._calls
        self._calls = []
        return program

    @cached_property
    def inputs(self) -> list[Field]:
        """States, parameters and inputs per substep, in the order in which the operators take them."""
        return [f for f in self.fields if f.kind in (FieldKind.STATE, FieldKind.PARAMETER, FieldKind.PER_SUBSTEP)]

    @cached_property
    def outputs(self) -> list[Field]:
        """States after the substep and sums, in the order in which the operators return them."""
        return [f for f in self.fields if f.kind in (FieldKind.NEXT, FieldKind.SUM)]

    def record_size(self, full: bool) -> int:
        """Return the count of numbers in a record: the state alone, or (full) all that the reverse sweep reads."""
        return self._call("record_size", int(full))

    def records_size(self, substeps: int, record_interval: int) -> int:
        """Return the count of numbers in all records of a scene, with the active triangles of contact."""
        return self._call("records_size", substeps, record_interval)

    def run(self, call: ctypes.Structure, mode: RunMode) -> None:
        """Run the program on the memory that ``call`` describes.

        Raises:
            RuntimeError: the engine fails.
        """
        _check(self._call("run", ctypes.byref(call), int(mode)))

    def _api(self, name: str) -> Callable[..., int]:
        """Return a stand-in for a function of the library that records its arguments (numbers and arrays)."""

        def record(handle: Any, *arguments) -> int:
            self._calls.append((name, arguments))
            return 0

        return record

    def _key(self) -> bytes:
        """Hash of all recorded calls, arrays included; version 0 of marshal knows no references between objects."""
        return hashlib.sha256(self._suffix.encode() + marshal.dumps(self._calls, 0)).digest()

    def _hand_over(self) -> None:
        self._handle = ctypes.c_void_p(getattr(library(), f"tc_new_{self._suffix}")())
        _check(not self._handle)
        for name, arguments in self._calls:
            status = self._call(name, *(_to_c(a) for a in arguments))
            _check(status < 0 if name in ("field", "table") else status)  # these return a number
        _check(self._call("lay_out"))
        self.number = next(_numbers)
        _by_number[self.number] = self

    def _call(self, name: str, *arguments) -> Any:
        return getattr(library(), f"tc_{name}_{self._suffix}")(self._handle, *arguments)


_cache: OrderedDict[bytes, Program] = OrderedDict()
_by_number: WeakValueDictionary[int, Program] = WeakValueDictionary()
_numbers = count()
_cache_lock = Lock()


def _replace_lock() -> None:
    """Replace the lock after a fork: a thread that held it in the parent does not exist in the child."""
    global _cache_lock
    _cache_lock = Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_replace_lock)


def _to_c(value: Any) -> Any:
    """Arrays as pointers to their memory, tuples as arrays of int."""
    if isinstance(value, np.ndarray):
        return value.ctypes.data
    return (ctypes.c_int * len(value))(*value) if isinstance(value, tuple) else value


def program_by_number(number: int) -> Program:
    """Return the program that an operator was given by its number.

    Raises:
        KeyError: the program does not exist any more.
    """
    return _by_number[number]


def _check(code: int) -> None:
    if code:
        raise RuntimeError(library().tc_error().decode())
