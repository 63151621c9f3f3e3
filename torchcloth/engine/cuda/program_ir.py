"""What a program consists of, from the calls that hand it to the engine."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..fields import Kind
from ..loops import ADD, LOAD, PUT, VARYING, By

ROOM = 8  # slots for nodes, at least, for every point that a cloth has; most see the same nodes
CORNERS = 3  # of a triangle
LISTS = (0, 7, 13)  # where those of points, of woken ones and of those asleep begin: parts/contact.py


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


class Transfer(NamedTuple):
    """Between a point's registers and the nodes around it."""

    code: int  # SPREAD, COLLECT
    field: int  # of the nodes
    offset: int  # first register
    share: int  # likewise, of SHARES
    by: By


class Loop(NamedTuple):
    """Instructions on every item."""

    items: int
    flat: bool
    code: list[Move | Call | Lookup | Transfer]
    counted: int = -1  # on those points of contact alone: POINTS, WOKEN, ASLEEP; -1: on all items

    def moves(self, *codes: int) -> list[Move]:
        """Those of some codes."""
        return [i for i in self.code if isinstance(i, Move) and i.code in codes]

    def transfers(self, code: int) -> list[Transfer]:
        """Those of a code."""
        return [i for i in self.code if isinstance(i, Transfer) and i.code == code]

    def listed(self, table: int) -> int:
        """Of a table of contact, what ``Layers.rows`` takes."""
        return VARYING - table - LISTS[self.counted]


class Stencil(NamedTuple):
    """Differences to neighbours, or their transpose."""

    table: int
    weight: int
    x: int
    y: int
    shape: int


class Layers(NamedTuple):
    """Which triangles take part in contact between layers, and the nodes around their points."""

    x: int
    base: int  # field of the points: lowest node
    fields: tuple[int, ...]  # of nodes and points
    corners: np.ndarray  # [3, E]
    places: np.ndarray  # [S, 3] barycentric
    spacing: float  # m
    skin: float  # m
    reach: float  # m
    chunk: int
    apart: np.ndarray | None  # [E, E] bool; None: all triangles take part always

    @property
    def triangles(self) -> int:
        """E."""
        return self.corners.shape[1]

    @property
    def points(self) -> int:
        """E S."""
        return self.triangles * len(self.places)

    @property
    def room(self) -> int:
        """Slots for nodes, a power of two."""
        return 1 << max(10, (ROOM * self.points - 1).bit_length())

    def rows(self, which: int) -> np.ndarray:
        """[E S] of each point, by what ``parts.contact.Rows`` names first: corners, triangle, own, place."""
        each, triangle = len(self.places), np.repeat(np.arange(self.triangles), len(self.places))
        if which < CORNERS:
            return self.corners[which][triangle]
        return (triangle, np.arange(self.points), np.tile(np.arange(each), self.triangles))[which - CORNERS]


class PerMass(NamedTuple):
    """out = given / mass on the nodes."""

    mass: int
    given: int
    out: int
    least: float


Stage = Loop | Stencil | Layers | PerMass


class Listing(NamedTuple):
    """A program."""

    fields: list[Place]
    next: dict[int, int]  # where states go
    tables: list[np.ndarray]
    stages: list[Stage]

    @property
    def layers(self) -> Layers | None:
        """Of a program with contact."""
        return next((stage for stage in self.stages if isinstance(stage, Layers)), None)


def listing(written: Sequence[tuple[str, tuple]]) -> Listing:
    """Of what ``Program`` has written down."""
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
            if counted >= 0 and found.layers is not None:
                items = found.layers.points
            # points out of a body's reach change nothing: all are gone through, and none is looked for
            found.stages.append(Loop(points[among] if among >= 0 else items, bool(flat), [], counted))
        elif name == "sieve":
            points[given[0]] = int(found.tables[given[5]][-1])
        elif name == "contact":
            found.stages.append(_layers(*given))
        elif name == "per_mass":
            found.stages.append(PerMass(*given))
        elif name == "stencil":
            found.stages.append(Stencil(*given))
        else:
            _code(found).append(_instruction(name, given))
    if (layers := found.layers) is not None:
        rows = {Kind.POINTS: layers.points, Kind.NODES: layers.room}
        found.fields[:] = [f._replace(rows=rows.get(f.kind, f.rows)) for f in found.fields]
    return found


def _layers(
    fields: tuple[int, ...],
    count: int,
    corners: np.ndarray,
    triangles: int,
    places: np.ndarray,
    each: int,
    lengths: np.ndarray,
    limits: tuple[int, int, int],
    order: np.ndarray,
    starts: np.ndarray,
    meet: np.ndarray,
    apart: np.ndarray,
) -> Layers:
    spacing, skin, reach = map(float, lengths)
    chunk, patches, size = limits
    matrix = None
    if patches:  # a bit for each triangle of a patch
        matrix = np.zeros((triangles, triangles), bool)
        bits = np.unpackbits(apart.reshape(triangles, patches, 1), axis=-1, bitorder="little")[..., :size].astype(bool)
        for patch in range(patches):
            own = order[starts[patch] : starts[patch + 1]]
            matrix[np.ix_(order, own)] = bits[:, patch, : len(own)]
    return Layers(fields[0], fields[1], fields[2:], corners, places, spacing, skin, reach, chunk, matrix)


def _code(found: Listing) -> list[Move | Call | Lookup | Transfer]:
    last = found.stages[-1]
    if not isinstance(last, Loop):
        raise ValueError("no loop to add to")
    return last.code


def _instruction(name: str, given: tuple) -> Move | Call | Lookup | Transfer:
    if name == "move" and given[0] in (LOAD, ADD, PUT):
        return Move(*given)
    if name == "call":
        return Call(given[0], given[1], given[2])
    if name == "lookup":
        return Lookup(given[0], given[1:4], given[4], given[5])
    if name == "transfer":
        return Transfer(given[0], given[1], given[3], given[4], By(given[5]))
    raise ValueError(f"no instruction {name!r}")
