"""Fields: rows of numbers that a program reads and writes."""

from __future__ import annotations

from typing import NamedTuple

from .enums import FieldKind


class Field(NamedTuple):
    """A field of a program.

    Attributes:
        id: number by which the engine knows it.
        rows: rows; 0 where the contact search sizes it at run time.
        comps: components of a row.
        kind: what it holds.
    """

    id: int
    rows: int
    comps: int
    kind: FieldKind
