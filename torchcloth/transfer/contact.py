"""The discretisation of contact: grid spacing and contact points, independent of the mesh."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import InvalidInput
from ..meshes import Mesh


@dataclass(frozen=True)
class Contact:
    """How finely layers of cloth see each other.

    Layers come to rest about 1.3 to 1.8 ``spacing`` apart. The points must be no farther apart than the grid's
    spacing, or layers pass through each other.

    Args:
        spacing: grid spacing [m]; None: the mesh's mean edge.
        subdivisions: contact points per triangle edge (points per triangle = its square); None: as many as the
            spacing asks for.
    """

    spacing: float | None = None
    subdivisions: int | None = None

    def resolve(self, mesh: Mesh) -> tuple[float, np.ndarray]:
        """(spacing [m], barycentric coordinates of the points of one triangle [S, 3]).

        Raises:
            InvalidInput: non-positive spacing, or points too sparse for it.
        """
        edge = mesh.mean_edge
        spacing = edge if self.spacing is None else float(self.spacing)
        if not spacing > 0:
            raise InvalidInput("contact spacing", got=f"{spacing:g} m", expected="a length > 0")
        needed = max(1, int(np.ceil(edge / spacing - 0.2)))
        s = needed if self.subdivisions is None else int(self.subdivisions)
        if s < needed:
            raise InvalidInput(
                "contact subdivisions",
                got=s,
                expected=f">= {needed} (mean edge {edge:.3g} m, spacing {spacing:.3g} m)",
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
