"""Intermediate representation of a program, from the recorded calls that hand it to the engine."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..enums import CONTACT_ROWS, ContactTable, FieldKind, Opcode, StencilForm, TransferBasis

MIN_NODE_SLOTS_PER_POINT = 8  # slots of the node table for every contact point of a cloth; most see the same nodes
TRIANGLE_CORNERS = 3
_GROUP_STARTS = (0, ContactTable.ACTIVATED, ContactTable.INACTIVE)  # first table, by ``ContactCount``


class FieldDecl(NamedTuple):
    """A field of the program.

    Attributes:
        kind: what it holds.
        rows: rows; those of nodes and points are the most that there can be.
        comps: components of a row.
        neighbours: of the weights of a stencil, else 0.
        data: numbers of a constant, else None.
    """

    kind: FieldKind
    rows: int
    comps: int
    neighbours: int
    data: np.ndarray | None

    @property
    def size(self) -> int:
        """Number of values in the field."""
        return self.rows * self.comps


class Move(NamedTuple):
    """Transfer between registers and a row.

    Attributes:
        code: ``Opcode.LOAD``, ``ADD`` or ``STORE``.
        field: number of the field.
        table: number of the table of rows, or ``ITEM_ROW``, ``SINGLE_ROW``, ``CONTACT_ROWS`` and below.
        reg: first register.
    """

    code: int
    field: int
    table: int
    reg: int


class Call(NamedTuple):
    """A kernel on registers.

    Attributes:
        kernel: number of the kernel.
        inputs: registers.
        outputs: registers. ``~register`` means that the result is added to that register.
    """

    kernel: int
    inputs: tuple[int, ...]
    outputs: tuple[int, ...]


class Lookup(NamedTuple):
    """Fractions and corner values of the cell of a grid.

    Attributes:
        field: values at the grid's nodes.
        nodes: nodes along x, y and z.
        place: first register of the place.
        out: first register of the results.
    """

    field: int
    nodes: tuple[int, int, int]
    place: int
    out: int


class Transfer(NamedTuple):
    """Transfer between a contact point's registers and the nodes around it.

    Attributes:
        code: ``Opcode.P2G`` or ``Opcode.G2P``.
        field: field of the nodes.
        offset: first register of the point's offset.
        shares: first register of its shares.
        basis: what the shares multiply.
    """

    code: int
    field: int
    offset: int
    shares: int
    basis: TransferBasis


class Loop(NamedTuple):
    """Instructions on every item.

    Attributes:
        items: items; of contact points all that there are.
        no_derivative: results have no derivative.
        code: instructions.
        contact_count: which contact points it runs on, a ``ContactCount``; -1: all items.
    """

    items: int
    no_derivative: bool
    code: list[Move | Call | Lookup | Transfer]
    contact_count: int = -1

    def moves(self, *codes: int) -> list[Move]:
        """Return the moves of these codes."""
        return [i for i in self.code if isinstance(i, Move) and i.code in codes]

    def transfers(self, code: int) -> list[Transfer]:
        """Return the transfers of this code."""
        return [i for i in self.code if isinstance(i, Transfer) and i.code == code]

    def contact_table(self, table: int) -> int:
        """Return the ``ContactTable`` that a table number means, counted from the start of the loop's group."""
        return CONTACT_ROWS - table - _GROUP_STARTS[self.contact_count]


class Stencil(NamedTuple):
    """Weighted differences to neighbours, or their transpose.

    Attributes:
        table: number of the table of neighbours.
        weight, x, y: numbers of fields.
        form: plain, transposed or symmetric.
    """

    table: int
    weight: int
    x: int
    y: int
    form: StencilForm


class ContactSearch(NamedTuple):
    """Which triangles are active in contact between layers, and the nodes around their points.

    Attributes:
        x: field of the positions.
        lowest_node: field of each point's lowest node.
        shift: field of where the grid lies [spacings].
        fields: fields of nodes and points.
        corners: [3, E] vertices.
        barycentric: [S, 3] barycentric coordinates of a triangle's points.
        spacing, search_skin, reach: of the grid [m].
        search_interval: substeps after which the search is repeated in any case.
        non_adjacent: [E, E] bool, pairs far apart along the cloth; None: all triangles are always active.
    """

    x: int
    lowest_node: int
    shift: int
    fields: tuple[int, ...]
    corners: np.ndarray
    barycentric: np.ndarray
    spacing: float
    search_skin: float
    reach: float
    search_interval: int
    non_adjacent: np.ndarray | None

    @property
    def triangles(self) -> int:
        """Count of triangles E."""
        return self.corners.shape[1]

    @property
    def points(self) -> int:
        """Count of points E S."""
        return self.triangles * len(self.barycentric)

    @property
    def node_slots(self) -> int:
        """Slots for nodes, a power of two."""
        return 1 << max(10, (MIN_NODE_SLOTS_PER_POINT * self.points - 1).bit_length())

    def rows(self, table: int) -> np.ndarray:
        """Return the rows [E S] of each point, by a ``ContactTable`` of the first group."""
        each, triangle = len(self.barycentric), np.repeat(np.arange(self.triangles), len(self.barycentric))
        if table < TRIANGLE_CORNERS:
            return self.corners[table][triangle]
        tables = (triangle, np.arange(self.points), np.tile(np.arange(each), self.triangles))
        return tables[table - ContactTable.TRIANGLE]


class GridVelocity(NamedTuple):
    """velocity = momentum / mass on the nodes; numbers of fields, and the mass [kg] below which it is 0."""

    mass: int
    momentum: int
    velocity: int
    min_mass: float


Stage = Loop | Stencil | ContactSearch | GridVelocity


class ProgramIR(NamedTuple):
    """A program.

    Attributes:
        fields: by number.
        next: field at the end of a substep, by that of the state at its start.
        tables: rows, by number.
        stages: in order.
    """

    fields: list[FieldDecl]
    next: dict[int, int]
    tables: list[np.ndarray]
    stages: list[Stage]

    @property
    def contact(self) -> ContactSearch | None:
        """The contact search; None without contact."""
        return next((stage for stage in self.stages if isinstance(stage, ContactSearch)), None)


def parse_program(calls: Sequence[tuple[str, tuple]]) -> ProgramIR:
    """Return the representation of a program, from the calls that ``Program`` has recorded.

    Raises:
        ValueError: a call is unknown.
    """
    program = ProgramIR([], {}, [], [])
    points: dict[int, int] = {}  # by broad phase
    for name, arguments in calls:
        if name == "field":
            kind, rows, comps, neighbours, _, data = arguments
            program.fields.append(FieldDecl(FieldKind(kind), rows, comps, neighbours, data))
        elif name == "next_state":
            program.next[arguments[0]] = arguments[1]
        elif name == "table":
            program.tables.append(arguments[0])
        elif name == "loop":
            items, point_list, contact_count, no_derivative, _ = arguments
            if contact_count >= 0 and program.contact is not None:
                items = program.contact.points
            # points out of a body's reach change nothing: all are visited, and there is no broad phase
            items = points[point_list] if point_list >= 0 else items
            program.stages.append(Loop(items, bool(no_derivative), [], contact_count))
        elif name == "broad_phase":
            points[arguments[0]] = int(program.tables[arguments[5]][-1])
        elif name == "contact_search":
            program.stages.append(_contact_search(*arguments))
        elif name == "grid_velocity":
            program.stages.append(GridVelocity(*arguments))
        elif name == "stencil":
            table, weight, x, y, form = arguments
            program.stages.append(Stencil(table, weight, x, y, StencilForm(form)))
        else:
            _code_of_last_loop(program).append(_instruction(name, arguments))
    if (contact := program.contact) is not None:
        rows = {FieldKind.POINTS: contact.points, FieldKind.NODES: contact.node_slots}
        program.fields[:] = [f._replace(rows=rows.get(f.kind, f.rows)) for f in program.fields]
    return program


def _contact_search(
    fields: tuple[int, ...],
    count: int,
    corners: np.ndarray,
    triangles: int,
    barycentric: np.ndarray,
    each: int,
    lengths: np.ndarray,
    limits: tuple[int, int, int],
    order: np.ndarray,
    patch_starts: np.ndarray,
    patches_may_meet: np.ndarray,
    non_adjacent: np.ndarray,
) -> ContactSearch:
    spacing, search_skin, reach = map(float, lengths)
    search_interval, patches, size = limits
    matrix = None
    if patches:  # a bit for each triangle of a patch
        matrix = np.zeros((triangles, triangles), bool)
        packed = non_adjacent.reshape(triangles, patches, 1)
        bits = np.unpackbits(packed, axis=-1, bitorder="little")[..., :size].astype(bool)
        for patch in range(patches):
            members = order[patch_starts[patch] : patch_starts[patch + 1]]
            matrix[np.ix_(order, members)] = bits[:, patch, : len(members)]
    x, lowest_node, shift, *others = fields
    return ContactSearch(
        x, lowest_node, shift, tuple(others), corners, barycentric, spacing, search_skin, reach, search_interval, matrix
    )


def _code_of_last_loop(program: ProgramIR) -> list[Move | Call | Lookup | Transfer]:
    last = program.stages[-1]
    if not isinstance(last, Loop):
        raise ValueError("no loop to add to")
    return last.code


def _instruction(name: str, arguments: tuple) -> Move | Call | Lookup | Transfer:
    if name == "move" and arguments[0] in (Opcode.LOAD, Opcode.ADD, Opcode.STORE):
        return Move(*arguments)
    if name == "kernel":
        return Call(arguments[0], arguments[1], arguments[2])
    if name == "lookup":
        return Lookup(arguments[0], arguments[1:4], arguments[4], arguments[5])
    if name == "transfer":
        return Transfer(arguments[0], arguments[1], arguments[3], arguments[4], TransferBasis(arguments[5]))
    raise ValueError(f"no instruction {name!r}")
