"""Stages of a program that are not loops: stencils, the broad phase of points near a body, the contact search."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from .enums import PATCH_TRIANGLES, StencilForm
from .fields import Field

RecordingApi = Callable[[str], Callable[..., int]]
"""Name of a function of the library -> stand-in that records its arguments; ``handle`` is the first of these."""


class ContactSearch(NamedTuple):
    """Search for the triangles that may touch another layer, and layout of the grid; see ``csrc/contact.h``.

    Attributes:
        fields: positions, lowest node of each point, shift of the grid, fields of the nodes, fields of the points.
        corners: [3, E] int32, vertices of the triangles.
        barycentric: [S, 3] float64, barycentric coordinates of a triangle's contact points.
        lengths: (spacing, search skin, reach) of the grid [m].
        search_interval: substeps after which the search is repeated in any case.
        order: [E] int32, triangles patch by patch.
        patch_starts: [patches + 1] int32; [1] where all triangles are always active.
        patches_may_meet: [patches, patches] uint8, whether two patches have triangles that may touch.
        non_adjacent: [E, patches] uint8, one bit for each triangle of a patch.
    """

    fields: Sequence[Field]
    corners: np.ndarray
    barycentric: np.ndarray
    lengths: tuple[float, float, float]
    search_interval: int
    order: np.ndarray
    patch_starts: np.ndarray
    patches_may_meet: np.ndarray
    non_adjacent: np.ndarray

    def emit(self, handle: object, api: RecordingApi) -> None:
        """Append the search to the program that the library builds."""
        ids = tuple(field.id for field in self.fields)
        limits = (self.search_interval, len(self.patch_starts) - 1, PATCH_TRIANGLES)
        sizes = self.corners.shape[1], len(self.barycentric)
        lengths = np.array(self.lengths, np.float64)
        patches = (self.order, self.patch_starts, self.patches_may_meet, self.non_adjacent)
        search = (np.ascontiguousarray(a) for a in patches)
        corners, barycentric = np.ascontiguousarray(self.corners), np.ascontiguousarray(self.barycentric)
        api("contact_search")(handle, ids, len(ids), corners, sizes[0], barycentric, sizes[1], lengths, limits, *search)


class GridVelocity(NamedTuple):
    """Division of the nodes' momentum by their mass; see ``Program.grid_velocity``.

    Attributes:
        mass: field of the nodes with their mass [kg].
        momentum: field of the nodes that is divided.
        velocity: field of the nodes for the quotient.
        min_mass: mass [kg] below which a node has no velocity.
    """

    mass: Field
    momentum: Field
    velocity: Field
    min_mass: float

    def emit(self, handle: object, api: RecordingApi) -> None:
        """Append the division to the program that the library builds."""
        api("grid_velocity")(handle, self.mass.id, self.momentum.id, self.velocity.id, self.min_mass)


class PointTables(NamedTuple):
    """Tables of sample points on triangles, in the order of the triangles.

    Attributes:
        corners: number of the table [3, E] of vertices.
        starts: number of the table [E + 1] of each triangle's first point.
        triangles: E.
    """

    corners: int
    starts: int
    triangles: int


class PointBroadPhase(NamedTuple):
    """List of the sample points that may touch a body; see ``Program.broad_phase``.

    Attributes:
        list_number: number of the list that the broad phase fills.
        x: [V, 3] positions [m].
        approach: [V, 2] distance to the body [m] and speed relative to it [m/s].
        dt: substep [s].
        points: tables of the points.
        lipschitz: Lipschitz constant of the body's distance function.
    """

    list_number: int
    x: Field
    approach: Field
    dt: Field
    points: PointTables
    lipschitz: float

    def emit(self, handle: object, api: RecordingApi) -> None:
        """Append the broad phase to the program that the library builds."""
        fields = (self.x.id, self.approach.id, self.dt.id)
        api("broad_phase")(handle, self.list_number, *fields, *self.points, self.lipschitz)


class Stencil(NamedTuple):
    """Linear operator on vertices; see ``Program.stencil``.

    Attributes:
        table: number of the table of neighbours.
        weight: weights of the neighbours.
        x: [V, 3] argument, or result of the transposed form.
        y: [V, 3 count] result, or argument of the transposed form.
        form: plain, transposed or symmetric.
    """

    table: int
    weight: Field
    x: Field
    y: Field
    form: StencilForm

    def emit(self, handle: object, api: RecordingApi) -> None:
        """Append the operator to the program that the library builds."""
        api("stencil")(handle, self.table, self.weight.id, self.x.id, self.y.id, int(self.form))
