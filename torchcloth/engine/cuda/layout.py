"""Memory of a program on a device: where its fields, constants and index tables lie.

The emitters of loops, stencils and contact read it, and reserve what they need.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..enums import CONTACT_ROWS, ITEM_ROW, SINGLE_ROW, FieldKind, Opcode, StencilForm
from .program_ir import FieldDecl, GridVelocity, Loop, Move, ProgramIR, Stage, Stencil, parse_program

WITHIN_SUBSTEP = (FieldKind.TEMPORARY, FieldKind.RECORDED)
CLEARED_IN_SUBSTEP = (*WITHIN_SUBSTEP, FieldKind.NODES)
NODES_OF_POINT = 27  # grid nodes around a contact point


class Layout:
    """Where everything lies that the kernels of a program read and write.

    Attributes:
        program: the program.
        data: constants, one after the other.
        shared: numbers that the threads of a block share, times (1 + warps).
        accumulated: places of the adjoints of parameters that all items share, by (field, component). They are summed
            in ``SceneContext::sums`` until the end.
        with_adjoint: fields that have an adjoint.
    """

    def __init__(self, calls: Sequence[tuple[str, tuple]]) -> None:
        self.program: ProgramIR = parse_program(calls)
        self.fields, self.contact = self.program.fields, self.program.contact
        self.shared = 1
        self._scratch = 0
        self._tables = [np.asarray(t, np.int32).ravel() for t in self.program.tables]
        self._added_tables: dict[bytes, int] = {}
        self._constant_places = self._lay_out_constants()
        self.accumulated = self._accumulated_parameter_adjoints()
        self.with_adjoint = self._fields_with_adjoint()

    # -- tables -------------------------------------------------------------------------------------------------------

    @property
    def tables(self) -> np.ndarray:
        """Indices, one table after the other."""
        return np.concatenate([*self._tables, np.zeros(1, np.int32)])

    def table(self, which: int) -> int:
        """Return where a table of the program begins."""
        return sum(len(t) for t in self._tables[:which])

    def add_table(self, numbers: np.ndarray) -> int:
        """Return where an additional table begins."""
        key = numbers.astype(np.int32).tobytes()
        if key not in self._added_tables:
            self._added_tables[key] = len(self._tables)
            self._tables.append(numbers.astype(np.int32).ravel())
        return self.table(self._added_tables[key])

    def corner_table(self, which: int) -> int:
        """Return where the table with a corner of all triangles in contact begins.

        Raises:
            ValueError: there is no contact.
        """
        if self.contact is None:
            raise ValueError("no contact")
        return self.add_table(self.contact.corners[which])

    def gather_tables(self, stage: Loop, moves: Sequence[Move]) -> tuple[int, int]:
        """Return where two tables begin, for a field to whose rows several items add.

        The first table has each row's first entry, the second one the entries' places in scratch memory.
        """
        rows = [self._rows(stage, m) for m in moves]
        comps, n = self.fields[moves[0].field].comps, stage.items
        places = np.concatenate([k * comps * n + np.arange(n) for k in range(len(moves))])
        return self._sorted_tables(np.concatenate(rows), places, self.fields[moves[0].field].rows)

    def inverse_tables(self, neighbours: int, vertices: int) -> tuple[int, int]:
        """Return two tables like ``gather_tables``, of the vertices that see each vertex: n V + v of each."""
        table = self._tables[neighbours]
        entries = np.arange(len(table))
        is_neighbour = table != entries % vertices
        return self._sorted_tables(table[is_neighbour], entries[is_neighbour], vertices)

    def _sorted_tables(self, rows: np.ndarray, places: np.ndarray, count: int) -> tuple[int, int]:
        order = np.argsort(rows, kind="stable")
        first = np.searchsorted(rows[order], np.arange(count + 1))
        return self.add_table(first), self.add_table(places[order])

    def _rows(self, stage: Loop, move: Move) -> np.ndarray:
        """Rows of all items."""
        if move.table == ITEM_ROW:
            return np.arange(stage.items)
        if move.table <= CONTACT_ROWS and self.contact is not None:
            return self.contact.rows(stage.contact_table(move.table))
        return self._tables[move.table][: stage.items]

    # -- sizes --------------------------------------------------------------------------------------------------------

    def reserve(self, scratch: int = 0, shared: int = 0) -> None:
        """Reserve memory that a stage needs."""
        self._scratch, self.shared = max(self._scratch, scratch), max(self.shared, shared)

    def fields_of(self, *kinds: FieldKind) -> list[tuple[int, FieldDecl]]:
        """Return the fields of some kinds with their numbers."""
        return [(k, f) for k, f in enumerate(self.fields) if f.kind in kinds]

    def places_of(self, *kinds: FieldKind) -> tuple[dict[int, int], int]:
        """Return (where each field of some kinds begins, the count of all their numbers)."""
        places, size = {}, 0
        for k, field in self.fields_of(*kinds):
            places[k] = size
            size += field.size
        return places, size

    @property
    def state_size(self) -> int:
        """Count of numbers in a state."""
        return self.places_of(FieldKind.STATE)[1]

    @property
    def values_size(self) -> int:
        """Count of numbers for values: two states, fields within a substep, sums, nodes, and scratch memory."""
        return 2 * self.state_size + self._inner[1] + self._scratch + self._reference_size

    @property
    def adjoint_size(self) -> int:
        """Count of numbers for values and adjoints; each substep takes ``state_size`` more."""
        return self.values_size + 2 * self.state_size + self._inner[1]

    @property
    def _inner(self) -> tuple[dict[int, int], int]:
        return self.places_of(*WITHIN_SUBSTEP, FieldKind.POINTS, FieldKind.SUM, FieldKind.NODES)

    @property
    def _reference_size(self) -> int:
        """Count of the positions at the last contact search."""
        return 0 if self.contact is None else self.fields[self.contact.x].size

    @property
    def grid_size(self) -> int:
        """Count of 32-bit integers of a scene for the nodes of contact."""
        if self.contact is None:
            return 0
        size = 6 * self.contact.node_slots + (4 + NODES_OF_POINT) * self.contact.points + 4
        return size + size % 2  # each scene begins with a 64-bit integer

    @property
    def node_slots(self) -> int:
        """Nodes of contact for which a scene has room."""
        return 0 if self.contact is None else self.contact.node_slots

    @property
    def mask_size(self) -> int:
        """Bytes of a substep that say which triangles are active."""
        return 0 if self.contact is None else self.contact.triangles

    def _lay_out_constants(self) -> dict[int, int]:
        places, parts, size = {}, [], 0
        for k, field in enumerate(self.fields):
            if field.kind == FieldKind.CONSTANT and field.data is not None:
                places[k] = size
                parts.append(field.data.ravel())
                size += field.size
        self.data = np.concatenate(parts) if parts else np.zeros(1)
        return places

    # -- who writes where ---------------------------------------------------------------------------------------------

    def fills(self, stage: Stage, field: int) -> bool:
        """Return whether a stage writes all rows of a field that no earlier stage writes."""
        if not isinstance(stage, Loop):
            return True
        if stage.contact_count >= 0:
            return False
        rows = self.fields[field].rows
        return all(
            (m.table == ITEM_ROW and stage.items == rows)
            or (
                m.code == Opcode.STORE
                if m.table == SINGLE_ROW
                else m.code == Opcode.ADD and not self.is_direct(stage, m, Opcode.ADD)
            )
            for m in stage.moves(Opcode.ADD, Opcode.STORE)
            if m.field == field
        )

    def is_direct(self, stage: Loop, move: Move, code: int) -> bool:
        """Return whether no two items, and no two instructions, access the same row."""
        if move.table == SINGLE_ROW or sum(m.field == move.field for m in stage.moves(code)) > 1:
            return False
        rows = self._rows(stage, move)
        return len(np.unique(rows)) == len(rows)

    def first_written(self, k: int) -> set[int]:
        """Return the fields within a substep that stage ``k`` writes and no earlier stage does."""
        stages = self.program.stages
        earlier = {f for stage in stages[:k] for f in _written_fields(stage)}
        return {f for f in _written_fields(stages[k]) if f not in earlier and self.fields[f].kind in CLEARED_IN_SUBSTEP}

    def fields_to_clear(self) -> list[int]:
        """Return the fields that must be zero when a substep begins."""
        stages = self.program.stages
        filled = {f for k, stage in enumerate(stages) for f in self.first_written(k) if self.fills(stage, f)}
        return [k for k, _ in self.fields_of(*WITHIN_SUBSTEP) if k not in filled]

    def _fields_with_adjoint(self) -> set[int]:
        kinds = FieldKind.PARAMETER, FieldKind.STATE, FieldKind.PER_SUBSTEP, FieldKind.NEXT, FieldKind.SUM
        fields = {k for k, _ in self.fields_of(*kinds, FieldKind.NODES)}
        for stage in self.program.stages:
            if isinstance(stage, Stencil):
                fields |= {stage.x, stage.y}
            elif isinstance(stage, Loop) and not stage.no_derivative:
                fields |= {m.field for m in stage.moves(Opcode.ADD, Opcode.STORE)}
        return {k for k in fields if self.fields[k].kind != FieldKind.CONSTANT}

    def _accumulated_parameter_adjoints(self) -> dict[tuple[int, int], int]:
        loops = [stage for stage in self.program.stages if isinstance(stage, Loop) and not stage.no_derivative]
        loads = [m for loop in loops for m in loop.moves(Opcode.LOAD) if m.table == SINGLE_ROW]
        shared = {m.field: None for m in loads if self.fields[m.field].kind == FieldKind.PARAMETER}
        return {place: k for k, place in enumerate((f, c) for f in shared for c in range(self.fields[f].comps))}


def _written_fields(stage: Stage) -> list[int]:
    if isinstance(stage, Stencil):
        return [stage.x if stage.form == StencilForm.TRANSPOSED else stage.y]
    if isinstance(stage, Loop):
        moves = stage.moves(Opcode.ADD, Opcode.STORE)
        return [m.field for m in (*moves, *stage.transfers(Opcode.P2G))]
    return [stage.velocity] if isinstance(stage, GridVelocity) else []
