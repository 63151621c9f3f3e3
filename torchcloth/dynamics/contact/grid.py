"""The discretisation of contact: grid spacing and contact points, independent of the mesh."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from numbers import Real
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ...errors import InvalidInput
from ...meshes import Mesh
from .neighbours import find_non_adjacent_triangles, find_overlapping_triangles

SEARCH_SKIN_SPACINGS = 2.0  # grid spacings that layers may approach each other before the search for near ones is repeated
INTERACTION_RANGE_SPACINGS = 4.0  # grid spacings: the splines of points farther apart have no node of any weight in common
COMPRESSION_ONSET_SPACINGS = 2.26  # grid spacings at which approaching layers begin to compress each other's directors
APPROACH_PER_COMPRESSION_SPACINGS = 3.5  # and by how many they must approach for each unit of 1 - R33 (both measured, tests/physics/test_contact)
REST_GAP_SPACINGS = 1.4  # grid spacings between layers at rest, with the default play
MAX_POINT_DISTANCE_SPACINGS = 1.4  # grid spacings between corners of sub-triangles: no hole between the points exceeds 0.7 spacings
WRAP_EXTENT_FACTOR = 1.6  # times the longest way along the cloth: the extent at which the grid wraps, so that layers never alias
MAX_POINTS_PER_EDGE = 100  # points along a triangle's edge: 10 000 in it
WARN_POINTS_PER_TRIANGLE = 64  # points in a triangle, of which a cloth says so; usual are 1 to 4
WARN_UNSEEN_LAYER_FRACTION = 0.5  # share of the triangles of layers that do not see the other layer, from which a cloth says so
FOLD_PATH_RATIO = 1.7  # layers are folded on each other where the way along the cloth is that much longer than through space


class Grid(NamedTuple):
    """What contact through the grid needs."""

    points: Tensor  # [S, 3] barycentric coordinates of each triangle's contact points
    spacing: float  # m
    nodes: int  # per axis before the grid wraps
    skin: float  # m, see SKIN
    reach: float  # m, centroids of triangles that may touch before the search is repeated
    free_compression: float  # compression 1 - R33 of the director before layers press
    damping: float  # s
    non_adjacent: Tensor | None  # [E, E] bool, not neighbours along the cloth; None: every triangle always takes part

    @property
    def max_extent(self) -> float:
        """Extent [m] of a cloth for which there is room before the grid wraps."""
        return (self.nodes - 4) * self.spacing

    @property
    def summary(self) -> str:
        """For the data sheet of a cloth."""
        gap, unseen = 1e3 * REST_GAP_SPACINGS * self.spacing, 1e3 * FOLD_PATH_RATIO * self.reach
        return (
            f"layers rest {gap:.3g} mm apart, unseen within {unseen:.3g} mm along the cloth; "
            f"{len(self.points)} point(s) per triangle"
        )

    def contact_warnings(self, mesh: Mesh) -> Iterator[str]:
        """What a user must know: of what contact costs, and of layers that lie over each other and do not meet."""
        if len(self.points) >= WARN_POINTS_PER_TRIANGLE:
            yield (
                f"contact: edges of some {1e3 * mesh.coarse_edge:.3g} mm take {len(self.points)} points in each "
                f"triangle near another layer, and each costs as much as a triangle ({self.summary}): give the mesh more "
                "triangles, or contact=Contact.with_gap(...) a larger gap"
            )
        pairs = find_overlapping_triangles(mesh, 2 * REST_GAP_SPACINGS * self.spacing)
        if self.non_adjacent is None or not len(pairs):
            return
        layered, seen = np.unique(pairs[:, 0]), np.unique(pairs[self.non_adjacent.cpu().numpy()[pairs[:, 0], pairs[:, 1]], 0])
        share = 1 - len(seen) / len(layered)
        if share > WARN_UNSEEN_LAYER_FRACTION:
            yield (
                f"contact: {100 * share:.0f} % of the triangles that lie over another layer do not see it and pass "
                f"through ({self.summary}): give contact=Contact.with_gap(...) a smaller gap, or the mesh more triangles"
            )


@dataclass(frozen=True)
class Contact:
    """How finely layers of cloth see each other.

    Layers come to rest ``GAP`` = 1.4 spacings apart (1.3 to 1.5, for pressures from a fabric's weight to a hundred
    times that); layers that start nearer stay nearer. Only triangles near another layer take part, and cost anything.
    Triangles are neighbours, and do not see each other, up to a way of about 10 spacings plus 3 edges along the cloth:
    ``print(cloth)`` says how far. A coarse cloth needs a finer mesh before its folds can touch.

    Cost: points per triangle grow with (edge / spacing)^2, so a small gap wants small triangles, and even ones: all get
    as many as the longest edges ask for. The stable step falls with spacing sqrt(areal density / (k h)), so a small gap
    wants k h of 30 to 100 N/m, far below published presets.

    Args:
        spacing: grid spacing [m]; None: the mesh's mean edge. See ``with_gap``.
        subdivisions: contact points per triangle edge (points per triangle = its square); None: as many as the
            spacing asks for; sparser points would let layers pass through each other.
        damping: of the collision [s] (Hunt and Crossley 1975): the pressure of closing layers grows, that of parting
            layers falls by damping times the rate of the director's compression. 0: layers bounce like rubber.
        play: compression 1 - R33 of the director at which layers begin to press. The splines of layers 2.3 spacings
            apart still overlap: with play 0, as published, they rest there.
        everywhere: let all triangles take part always, as material point methods do; for comparison.

    Raises:
        InvalidInput: negative damping, or a play outside [0, 0.5].
    """

    spacing: float | None = None
    subdivisions: int | None = None
    damping: float = 0.1
    free_compression: float = 0.25
    everywhere: bool = False

    def __post_init__(self) -> None:
        if not 0 <= self.damping < float("inf"):
            raise InvalidInput("contact damping", got=f"{self.damping} s", expected="a time >= 0")
        if not 0 <= self.free_compression <= 0.5:
            raise InvalidInput("contact free_compression", got=self.free_compression, expected="a number in [0, 0.5]")

    @classmethod
    def with_gap(cls, gap: float, **changes) -> Contact:
        """Contact whose layers rest ``gap`` [m] apart, from centre to centre; ``changes`` as for the class."""
        if not 0 < gap < float("inf"):
            raise InvalidInput("contact gap", got=f"{gap:g} m", expected="a length > 0")
        return cls(spacing=gap / REST_GAP_SPACINGS, **changes)

    def build_grid(self, mesh: Mesh) -> Grid:
        """Everything that mesh and contact fix, in the default precision.

        Raises:
            InvalidInput: a spacing that is not positive, or longer than the cloth, or points too sparse or many for it.
        """
        spacing, points = self.resolve(mesh)
        corner = mesh.rest - mesh.rest.mean(1, keepdims=True)
        reach = float((INTERACTION_RANGE_SPACINGS + SEARCH_SKIN_SPACINGS) * spacing + 2 * np.linalg.norm(corner, axis=-1).max())
        longest = max(float(np.linalg.norm(np.ptp(mesh.vertices, axis=0))), mesh.extent)
        if spacing > longest:
            expected = f"at most the length of the cloth, {longest:.3g} m"
            raise InvalidInput("contact spacing", got=f"{spacing:g} m", expected=expected)
        return Grid(
            points=torch.as_tensor(points, dtype=torch.get_default_dtype()),
            spacing=spacing,
            nodes=int(np.ceil(WRAP_EXTENT_FACTOR * longest / spacing)) + 6,
            skin=SEARCH_SKIN_SPACINGS * spacing,
            reach=reach,
            free_compression=self.free_compression,
            damping=self.damping,
            non_adjacent=None if self.everywhere else torch.as_tensor(find_non_adjacent_triangles(mesh, FOLD_PATH_RATIO * reach)),
        )

    def resolve(self, mesh: Mesh) -> tuple[float, np.ndarray]:
        """(spacing [m], barycentric coordinates of the points of one triangle [S, 3]).

        Raises:
            InvalidInput: a spacing that is not positive, or points too sparse or many for it.
        """
        edge = mesh.coarse_edge
        spacing = mesh.mean_edge if self.spacing is None else float(self.spacing)
        if not spacing > 0:
            raise InvalidInput("contact spacing", got=f"{spacing:g} m", expected="a length > 0")
        if not spacing * MAX_POINT_DISTANCE_SPACINGS * MAX_POINTS_PER_EDGE >= edge:
            raise InvalidInput(
                "contact spacing",
                got=f"{spacing:g} m, for which a triangle needs {edge / (MAX_POINT_DISTANCE_SPACINGS * spacing):.2g} points along an edge",
                expected=f"{edge / (MAX_POINT_DISTANCE_SPACINGS * MAX_POINTS_PER_EDGE):.2g} m or more on this mesh",
                remedy="refine the mesh, or give the grid's spacing in metres",
            )
        needed = max(1, int(np.ceil(edge / (MAX_POINT_DISTANCE_SPACINGS * spacing))))
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
    """Barycentric centroids [s^2, 3] of the s^2 equal sub-triangles of a triangle."""
    rows = []
    for i in range(s):
        for j in range(s - i):
            rows.append((i + 1 / 3, j + 1 / 3))
            if i + j < s - 1:
                rows.append((i + 2 / 3, j + 2 / 3))
    uv = np.array(rows) / s
    return np.column_stack([1 - uv.sum(1), uv])
