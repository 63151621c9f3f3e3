"""Discretisation of the contact between layers: grid spacing and contact points."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from numbers import Real
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..._utils.constants import STANDARD_GRAVITY_M_PER_S2
from ...errors import InvalidInput
from ...meshes import Mesh
from .compression import layer_pressure
from .neighbours import find_non_adjacent_triangles, find_overlapping_triangles

# Lengths in grid spacings.
SEARCH_SKIN_SPACINGS = 2.0  # by how much layers may approach each other before candidates are searched again
INTERACTION_RANGE_SPACINGS = 4.0  # splines of points farther apart share no node of any weight
REST_GAP_SPACINGS = 1.4  # between layers at rest, with the default free compression
MAX_POINT_DISTANCE_SPACINGS = 1.4  # between corners of sub-triangles: no hole between points exceeds 0.7 spacings
# The grid wraps at this multiple of the longest path along the cloth, so that layers never meet their own images.
WRAP_EXTENT_FACTOR = 1.6
MAX_POINTS_PER_EDGE = 100  # that is 10 000 points in a triangle
WARN_POINTS_PER_TRIANGLE = 64  # usual are 1 to 4
MIN_MEETING_PAIR_FRACTION = 0.2  # of all pairs of triangles, those that can meet, for contact that is on by default
WARN_UNSEEN_LAYER_FRACTION = 0.5  # of the triangles in layers, those that do not see the other layer
FOLD_PATH_RATIO = 1.7  # layers are folded on each other where the path along the cloth is so much longer than in space

# Steps of the R3 sequence (Roberts 2018): powers of 1 / 1.2207, where 1.2207 solves x^4 = x + 1.
SHIFT_STEPS_SPACINGS = (0.8191725133961645, 0.6710436067037893, 0.5497004779019703)


def grid_shifts(first: int, count: int) -> Tensor:
    """Return where the grid lies at some substeps, [count, 3] float64 in spacings from 0 to 1.

    The grid moves in every substep, so that contact does not depend on where layers lie in it. Fluid simulations by
    particles shift their cells for the same reason (Ihle and Kroll 2001). The places fill the cell evenly, better than
    random ones would.
    """
    substep = torch.arange(first, first + count, dtype=torch.float64)
    return (substep[:, None] * torch.tensor(SHIFT_STEPS_SPACINGS, dtype=torch.float64)) % 1.0


class Grid(NamedTuple):
    """Contact points and grid of one cloth.

    Attributes:
        points: [S, 3], barycentric coordinates of the contact points of each triangle.
        spacing: grid spacing [m].
        nodes: number of nodes per axis before the grid wraps.
        search_skin: SEARCH_SKIN_SPACINGS in metres, the margin of the search (Verlet 1967). A search stays valid until
            a vertex has moved by half of it.
        reach: distance [m] of the centroids of triangles that may touch before candidates are searched again.
        free_compression: compression 1 - R33 of the director before layers press, dimensionless.
        damping: of the collision [s].
        non_adjacent: [E, E] bool, pairs of triangles that are not neighbours along the cloth; None: every triangle
            always takes part.
        first_substep: number, in the whole simulation, of the substep that row 0 of the prescribed motion belongs to.
    """

    points: Tensor
    spacing: float
    nodes: int
    search_skin: float
    reach: float
    free_compression: float
    damping: float
    non_adjacent: Tensor | None
    first_substep: int = 0

    def shift(self, substep: int) -> Tensor:
        """Return where the grid lies, [3] in spacings, at the substep of a row of the prescribed motion."""
        return grid_shifts(self.first_substep + substep, 1)[0]

    @property
    def max_extent(self) -> float:
        """Largest extent [m] of a cloth that fits into the grid before it wraps."""
        return (self.nodes - 4) * self.spacing

    @property
    def can_act(self) -> bool:
        """Whether at least a fifth of all pairs of triangles are no neighbours, so that layers can meet."""
        return self.non_adjacent is None or float(self.non_adjacent.double().mean()) >= MIN_MEETING_PAIR_FRACTION

    def find_layers(self, mesh: Mesh) -> np.ndarray:
        """Return pairs of triangles [N, 2] that lie over each other, within two gaps."""
        return find_overlapping_triangles(mesh, 2 * REST_GAP_SPACINGS * self.spacing)

    @property
    def summary(self) -> str:
        """Description for the data sheet of a cloth: gap between layers, and points per triangle."""
        gap, unseen = 1e3 * REST_GAP_SPACINGS * self.spacing, 1e3 * FOLD_PATH_RATIO * self.reach
        return (
            f"layers rest {gap:.3g} mm apart, unseen within {unseen:.3g} mm along the cloth; "
            f"{len(self.points)} point(s) per triangle"
        )

    def contact_warnings(self, mesh: Mesh, stiffness: Tensor, areal_density: Tensor) -> Iterator[str]:
        """Yield warnings about contact that is weak or costly, or that layers over each other do not have.

        Args:
            mesh: of the cloth.
            stiffness: k h [N/m], of any shape.
            areal_density: [kg/m^2], of any shape.
        """
        weakest, weight = float(stiffness.min()), STANDARD_GRAVITY_M_PER_S2 * float(areal_density.max())
        largest = layer_pressure(np.linspace(0, REST_GAP_SPACINGS, 29), self.free_compression).max()
        needed = weight * self.spacing / largest
        if weakest < needed:
            yield (
                f"contact: a stiffness k h of {weakest:.3g} N/m cannot carry the cloth's weight of {weight:.3g} Pa, so "
                f"layers pass through each other; that takes {needed:.2g} N/m or more (contact_stiffness times "
                "thickness)"
            )
        if len(self.points) >= WARN_POINTS_PER_TRIANGLE:
            yield (
                f"contact: edges of some {1e3 * mesh.coarse_edge:.3g} mm take {len(self.points)} points in each "
                f"triangle near another layer, and each costs as much as a triangle ({self.summary}): give the mesh "
                "more triangles, or a larger gap (layer_gap of an episode, contact=Contact.with_gap(...))"
            )
        pairs = self.find_layers(mesh)
        if self.non_adjacent is None or not len(pairs):
            return
        is_seen = self.non_adjacent.cpu().numpy()[pairs[:, 0], pairs[:, 1]]
        unseen_fraction = 1 - len(np.unique(pairs[is_seen, 0])) / len(np.unique(pairs[:, 0]))
        if unseen_fraction > WARN_UNSEEN_LAYER_FRACTION:
            yield (
                f"contact: {100 * unseen_fraction:.0f} % of the triangles that lie over another layer do not see it "
                f"and pass through ({self.summary}): give a smaller gap "
                "(layer_gap of an episode, contact=Contact.with_gap(...)), or the mesh more triangles"
            )


@dataclass(frozen=True)
class Contact:
    """Discretisation of the contact between layers of cloth, independent of the mesh.

    Layers come to rest 1.4 grid spacings apart, wherever they lie in the grid. Under a hundred times a fabric's weight
    they are 1.0 spacings apart (``compression.layer_pressure``). Layers that start nearer stay nearer. Only triangles
    near another layer take part and cost time. Triangles within about 10 spacings plus 3 edges along the cloth count as
    neighbours and do not interact: ``print(cloth)`` says how far. A coarse cloth needs a finer mesh before its folds
    can touch.

    Cost: points per triangle grow with (edge / spacing)^2, so a small gap needs small triangles of even size, because
    all get as many points as the longest edges need. The stable step falls with spacing sqrt(areal density / (k h)), so
    a small gap needs k h of 30 to 100 N/m, far below published presets.

    Args:
        spacing: grid spacing [m]; None: the mesh's mean edge. See ``with_gap``.
        subdivisions: contact points per triangle edge (points per triangle = its square); None: as many as the
            spacing needs. Sparser points would let layers pass through each other.
        damping: of the collision [s] (Hunt and Crossley 1975). The pressure grows as layers close and falls as they
            part, by damping times the rate of the director's compression. 0: layers bounce like rubber.
        free_compression: compression 1 - R33 of the director at which layers begin to press. The splines of layers up
            to 3 spacings apart overlap: with 0, as published, layers rest 2.2 spacings apart.
        everywhere: all triangles always take part, as in material point methods; for comparison.

    Raises:
        InvalidInput: negative damping, or a free compression outside [0, 0.5].
    """

    spacing: float | None = None
    subdivisions: int | None = None
    damping: float = 0.1
    free_compression: float = 0.15
    everywhere: bool = False

    def __post_init__(self) -> None:
        if not 0 <= self.damping < float("inf"):
            raise InvalidInput("contact damping", got=f"{self.damping} s", expected="a time >= 0")
        if not 0 <= self.free_compression <= 0.5:
            raise InvalidInput("contact free_compression", got=self.free_compression, expected="a number in [0, 0.5]")

    @classmethod
    def with_gap(cls, gap: float, **changes) -> Contact:
        """Build contact whose layers rest ``gap`` [m] apart, from centre to centre; ``changes`` as for the class.

        Raises:
            InvalidInput: a gap that is not positive.
        """
        if not 0 < gap < float("inf"):
            raise InvalidInput("contact gap", got=f"{gap:g} m", expected="a length > 0")
        return cls(spacing=gap / REST_GAP_SPACINGS, **changes)

    def build_grid(self, mesh: Mesh) -> Grid:
        """Build the contact grid of a mesh, in the default precision.

        Raises:
            InvalidInput: a spacing that is not positive, or longer than the cloth, or points too sparse or many for it.
        """
        spacing, points = self.resolve(mesh)
        corner = mesh.rest - mesh.rest.mean(1, keepdims=True)
        reach = float(
            (INTERACTION_RANGE_SPACINGS + SEARCH_SKIN_SPACINGS) * spacing + 2 * np.linalg.norm(corner, axis=-1).max()
        )
        longest = max(float(np.linalg.norm(np.ptp(mesh.vertices, axis=0))), mesh.extent)
        if spacing > longest:
            expected = f"at most the length of the cloth, {longest:.3g} m"
            raise InvalidInput("contact spacing", got=f"{spacing:g} m", expected=expected)
        return Grid(
            points=torch.as_tensor(points, dtype=torch.get_default_dtype()),
            spacing=spacing,
            nodes=int(np.ceil(WRAP_EXTENT_FACTOR * longest / spacing)) + 6,
            search_skin=SEARCH_SKIN_SPACINGS * spacing,
            reach=reach,
            free_compression=self.free_compression,
            damping=self.damping,
            non_adjacent=None
            if self.everywhere
            else torch.as_tensor(find_non_adjacent_triangles(mesh, FOLD_PATH_RATIO * reach)),
        )

    def resolve(self, mesh: Mesh) -> tuple[float, np.ndarray]:
        """Return the spacing [m], and the barycentric coordinates [S, 3] of the points of one triangle.

        Raises:
            InvalidInput: a spacing that is not positive, or points too sparse or many for it.
        """
        edge = mesh.coarse_edge
        spacing = mesh.mean_edge if self.spacing is None else float(self.spacing)
        if not spacing > 0:
            raise InvalidInput("contact spacing", got=f"{spacing:g} m", expected="a length > 0")
        per_edge = edge / (MAX_POINT_DISTANCE_SPACINGS * spacing)
        if not spacing * MAX_POINT_DISTANCE_SPACINGS * MAX_POINTS_PER_EDGE >= edge:
            raise InvalidInput(
                "contact spacing",
                got=f"{spacing:g} m, for which a triangle needs {per_edge:.2g} points along an edge",
                expected=f"{edge / (MAX_POINT_DISTANCE_SPACINGS * MAX_POINTS_PER_EDGE):.2g} m or more on this mesh",
                remedy="refine the mesh, or give the grid's spacing in metres",
            )
        needed = max(1, int(np.ceil(per_edge)))
        s = needed if self.subdivisions is None else self.subdivisions
        if not isinstance(s, Real) or s % 1 != 0:
            raise InvalidInput("contact subdivisions", got=self.subdivisions, expected="a whole number")
        s = int(s)
        if s > MAX_POINTS_PER_EDGE:
            raise InvalidInput("contact subdivisions", got=s, expected=f"at most {MAX_POINTS_PER_EDGE}")
        if s < needed:
            raise InvalidInput(
                "contact subdivisions",
                got=s,
                expected=f">= {needed} (edges of some {edge:.3g} m, spacing {spacing:.3g} m)",
                remedy="sparser points would let layers pass through each other",
            )
        return spacing, _centroids(s)


def _centroids(s: int) -> np.ndarray:
    """Return barycentric centroids [s^2, 3] of the s^2 equal sub-triangles of a triangle."""
    rows = []
    for i in range(s):
        for j in range(s - i):
            rows.append((i + 1 / 3, j + 1 / 3))
            if i + j < s - 1:
                rows.append((i + 2 / 3, j + 2 / 3))
    uv = np.array(rows) / s
    return np.column_stack([1 - uv.sum(1), uv])
