"""Enumerations and sizes that Python and C++ share.

``csrc/enums.h`` has the same list. ``library`` compares the two when it loads the compiled engine, so a value that
differs is an error at load time.
"""

from __future__ import annotations

from enum import IntEnum

ITEM_ROW = -1  # in the place of a table number: item i reads and writes row i
SINGLE_ROW = -2  # in the place of a table number: all items read, or add to, row 0
CONTACT_ROWS = -3  # this and below, in the place of a table number: rows that the contact search lists at run time
TRANSFER_SHARES = 16  # numbers of a contact point in a transfer: four times (mass or nothing, vector)
PATCH_TRIANGLES = 8  # triangles of a patch of the contact search: one bit of a byte for each
MAX_LANES = 16  # numbers of the widest pack, which holds float32


class FieldKind(IntEnum):
    """What a field of a program holds.

    Attributes:
        CONSTANT: numbers of the mesh or of a part, which never change.
        PARAMETER: an input with a derivative.
        STATE: the state at the start of a substep.
        NEXT: the state at its end.
        TEMPORARY: numbers within a substep.
        RECORDED: the same, recorded because the reverse sweep reads them.
        PER_SUBSTEP: an input with one row for every substep.
        SUM: a result that is summed over the substeps of a frame.
        NODES: mass and vector of the contact grid's active nodes.
        POINTS: numbers that loops over contact points hand to each other.
    """

    CONSTANT, PARAMETER, STATE, NEXT, TEMPORARY, RECORDED, PER_SUBSTEP, SUM, NODES, POINTS = range(10)


class Opcode(IntEnum):
    """Instructions of a loop.

    Attributes:
        LOAD: gather a row into registers.
        CALL: run a kernel on registers.
        ADD: add registers to a row.
        STORE: write registers to a row.
        LOOKUP: read the cell of a grid around a place.
        P2G: add a contact point's shares to the grid nodes around it (particle to grid).
        G2P: sum the grid nodes around a contact point (grid to particle).
    """

    LOAD, CALL, ADD, STORE, LOOKUP, P2G, G2P = range(7)


class TransferBasis(IntEnum):
    """What a transfer between points and nodes carries besides the weighted value.

    Attributes:
        GRADIENT: factors are the slopes of the weights.
        AFFINE: factors are the weights times the arm from point to node.
    """

    GRADIENT, AFFINE = range(2)


class StencilForm(IntEnum):
    """Linear operator of a stencil: plain, minus its transpose, or plain and equal to its transpose."""

    PLAIN, TRANSPOSED, SYMMETRIC = range(3)


class ContactTable(IntEnum):
    """First row table of each group that the contact search lists.

    Tables of active points come first: three of ``CORNERS``, one each of the others. Points of triangles that were just
    activated, and of inactive ones, have tables of their own from ``ACTIVATED`` and ``INACTIVE`` on.
    """

    CORNERS, TRIANGLE, POINT, PLACE, NODES = 0, 3, 4, 5, 6
    ACTIVATED, INACTIVE = 7, 13


class ContactCount(IntEnum):
    """Which points a loop over contact runs on: active ones, those just activated, or inactive ones."""

    ACTIVE, ACTIVATED, INACTIVE = range(3)


class RunMode(IntEnum):
    """What a run of a program computes: values, adjoints, or tangents."""

    VALUES, ADJOINTS, TANGENTS = range(3)


class TapeOp(IntEnum):
    """Operations of a kernel; a name with C has one constant operand."""

    INPUT, CONSTANT, ADD, SUB, MUL, DIV, ADDC, RSUBC, MULC, RDIVC, NEG, SQRT, EXP, EXPM1 = range(14)
    ATAN2, ABS, AT_LEAST, AT_MOST, LESS, LESSC, CLESS, SELECT, DETACH = range(14, 23)


_ENUMERATIONS = (FieldKind, Opcode, TransferBasis, StencilForm, ContactTable, ContactCount, RunMode, TapeOp)
_SIZES = {
    "item_row": ITEM_ROW,
    "single_row": SINGLE_ROW,
    "contact_rows": CONTACT_ROWS,
    "transfer_shares": TRANSFER_SHARES,
    "patch_triangles": PATCH_TRIANGLES,
    "max_lanes": MAX_LANES,
}


def check_shared_enums(text: str) -> None:
    """Compare the enumerations with those of the compiled library.

    Args:
        text: what ``tc_enums`` of the library returns, a line "NAME member=value ..." for each enumeration.

    Raises:
        RuntimeError: the two differ.
    """
    expected = {
        cls.__name__: {name.lower(): int(value) for name, value in cls.__members__.items()} for cls in _ENUMERATIONS
    }
    expected["Sizes"] = _SIZES
    compiled = {}
    for line in text.splitlines():
        name, *members = line.split()
        compiled[name] = {key: int(value) for key, _, value in (member.partition("=") for member in members)}
    for name in expected.keys() | compiled.keys():
        if expected.get(name) != compiled.get(name):
            raise RuntimeError(
                f"{name}: engine/enums.py has {expected.get(name)}, engine/csrc/enums.h has {compiled.get(name)}"
            )
