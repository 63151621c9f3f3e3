"""Fields: rows of numbers that a program reads and writes."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple


class Kind(IntEnum):
    """What a field is; as in csrc/program.h."""

    CONSTANT, PARAMETER, STATE, NEXT, TEMPORARY, KEPT, DRIVE, SUM, NODES, POINTS = range(10)


class Field(NamedTuple):
    """Rows of numbers, by the engine's number."""

    id: int
    rows: int
    comps: int
    kind: Kind
