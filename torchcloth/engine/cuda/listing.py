"""What a program consists of, from the calls that hand it to the engine."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..fields import Kind
from ..loops import ADD, LOAD, PUT
from ..lowering import Unfused


class Place(NamedTuple):
    """A field as the listing has it."""

    kind: Kind
    rows: int
    comps: int
    near: int  # of the weights of a stencil
    data: np.ndarray | None  # of a constant

    @property
    def size(self) -> int:
        """Numbers."""
        return self.rows * self.comps


class Move(NamedTuple):
    """Between registers and rows."""

    code: int  # LOAD, ADD, PUT
    field: int
    table: int
    reg: int


class Call(NamedTuple):
    """A kernel on registers; results by ~register are added to it."""

    kernel: int
    inputs: tuple[int, ...]
    outputs: tuple[int, ...]


class Lookup(NamedTuple):
    """Fractions and corners of the cell of a grid."""

    field: int
    nodes: tuple[int, int, int]
    place: int  # first register
    out: int  # likewise


class Loop(NamedTuple):
    """Instructions on every item."""

    items: int
    flat: bool
    code: list[Move | Call | Lookup]

    def moves(self, *codes: int) -> list[Move]:
        """Those of some codes."""
        return [i for i in self.code if isinstance(i, Move) and i.code in codes]


class Stencil(NamedTuple):
    """Differences to neighbours, or their transpose."""

    table: int
    weight: int
    x: int
    y: int
    shape: int


class Listing(NamedTuple):
    """A program."""

    fields: list[Place]
    next: dict[int, int]  # where states go
    tables: list[np.ndarray]
    stages: list[Loop | Stencil]


def listing(written: Sequence[tuple[str, tuple]]) -> Listing:
    """Of what ``Program`` has written down.

    Raises:
        Unfused: contact between layers, which has no kernels here.
    """
    found = Listing([], {}, [], [])
    points: dict[int, int] = {}  # of each sieve
    for name, given in written:
        if name == "field":
            kind, rows, comps, near, _, data = given
            found.fields.append(Place(Kind(kind), rows, comps, near, data))
        elif name == "pair":
            found.next[given[0]] = given[1]
        elif name == "table":
            found.tables.append(given[0])
        elif name == "loop":
            items, among, counted, flat, _ = given
            if counted >= 0:
                raise Unfused("contact between layers")
            # points out of reach change nothing: all are gone through, and none is looked for
            found.stages.append(Loop(points[among] if among >= 0 else items, bool(flat), []))
        elif name == "sieve":
            points[given[0]] = int(found.tables[given[5]][-1])
        elif name == "stencil":
            found.stages.append(Stencil(*given))
        else:
            _code(found).append(_instruction(name, given))
    return found


def _code(found: Listing) -> list[Move | Call | Lookup]:
    last = found.stages[-1]
    if not isinstance(last, Loop):
        raise ValueError("no loop to add to")
    return last.code


def _instruction(name: str, given: tuple) -> Move | Call | Lookup:
    if name == "move" and given[0] in (LOAD, ADD, PUT):
        return Move(*given)
    if name == "call":
        return Call(given[0], given[1], given[2])
    if name == "lookup":
        return Lookup(given[0], given[1:4], given[4], given[5])
    raise Unfused("contact between layers")
