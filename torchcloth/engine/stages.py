"""Stages of a program that are not loops: stencils, the sieve of points near a body, the search for layers."""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from .fields import Field

PATCH = 8  # triangles of a patch, as in csrc/search.h: a bit of a byte for each


class Shape(IntEnum):
    """Of a stencil's operator; as in csrc/stencil.h."""

    PLAIN, TRANSPOSED, SYMMETRIC = range(3)


class Layers(NamedTuple):
    """Contact between layers: which triangles may take part, and the grid; see csrc/contact.h."""

    fields: Sequence[Field]  # positions, lowest node of each point, fields of the nodes
    corners: np.ndarray  # [3, E] int32
    places: np.ndarray  # [S, 3] float64, barycentric
    lengths: tuple[float, float, float]  # spacing, skin, reach [m]
    chunk: int
    order: np.ndarray  # [E] int32, patch by patch
    starts: np.ndarray  # [patches + 1] int32; [1]: all triangles take part always
    meet: np.ndarray  # [patches, patches] uint8
    apart: np.ndarray  # [E, patches] uint8, a bit for each triangle of a patch

    def emit(self, handle, api) -> None:
        """Write it down."""
        ids = tuple(field.id for field in self.fields)
        limits = (self.chunk, len(self.starts) - 1, PATCH)
        sizes = self.corners.shape[1], len(self.places)
        lengths = np.array(self.lengths, np.float64)
        search = (np.ascontiguousarray(a) for a in (self.order, self.starts, self.meet, self.apart))
        corners, places = np.ascontiguousarray(self.corners), np.ascontiguousarray(self.places)
        api("contact")(handle, ids, len(ids), corners, sizes[0], places, sizes[1], lengths, limits, *search)


class PerMass(NamedTuple):
    """See ``Program.per_mass``."""

    mass: Field
    given: Field
    out: Field
    least: float

    def emit(self, handle, api) -> None:
        """Write it down."""
        api("per_mass")(handle, self.mass.id, self.given.id, self.out.id, self.least)


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
