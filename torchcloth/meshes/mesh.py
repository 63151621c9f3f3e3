"""The triangle mesh of a cloth, and the geometry of its rest shape."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..errors import InvalidInput


@dataclass(frozen=True, eq=False)
class Mesh:
    """A cloth's triangles, where they start, and what shape they would take without force.

    Attributes:
        vertices: [V, 3] m, a world placement of the unstrained cloth.
        faces: [F, 3] int64, counter-clockwise seen from the side of the normal.
        rest: [F, 3, 2] m, each triangle's corners in material axes (warp, weft). From ``uv`` when the mesh has pattern
            coordinates, so that seams may have two; else from the vertices, warp along the triangle's first edge.
        uv: [V, 2] m or None, pattern coordinates (u = warp, v = weft).
    """

    vertices: np.ndarray
    faces: np.ndarray
    rest: np.ndarray
    uv: np.ndarray | None = None

    @staticmethod
    def build(vertices: ArrayLike, faces: ArrayLike, uv: ArrayLike | None = None) -> Mesh:
        """Check the arrays and derive the rest shape.

        Raises:
            InvalidInput: wrong shapes, indices out of range, unused vertices, degenerate or flipped triangles.
        """
        x = np.array(vertices, dtype=np.float64)
        f = np.array(faces, dtype=np.int64)
        if x.ndim != 2 or x.shape[1] != 3 or not np.isfinite(x).all():
            raise InvalidInput("vertices", got=f"shape {x.shape}", expected="finite [V, 3] in metres")
        if f.ndim != 2 or f.shape[1] != 3 or len(f) == 0:
            raise InvalidInput("faces", got=f"shape {f.shape}", expected="[F, 3] vertex indices, F > 0")
        if f.min() < 0 or f.max() >= len(x):
            raise InvalidInput(
                "faces", got=f"indices {f.min()}..{f.max()}", expected=f"0..{len(x) - 1}, one per row of vertices"
            )
        unused = np.setdiff1d(np.arange(len(x)), f)
        if len(unused):
            raise InvalidInput(
                "vertices",
                got=f"{len(unused)} in no triangle (first: {unused[0]})",
                expected="every vertex in a triangle",
                remedy="a vertex without area has no mass; remove it",
            )
        pattern = None if uv is None else np.array(uv, dtype=np.float64)
        if pattern is not None and pattern.shape != (len(x), 2):
            raise InvalidInput("uv", got=f"shape {pattern.shape}", expected=f"[{len(x)}, 2] in metres")
        rest = _flatten(x[f]) if pattern is None else pattern[f]
        area = signed_area(rest)
        if pattern is not None and (area < 0).all():  # a pattern seen from behind: same cloth, other side up
            rest = rest * np.array([-1.0, 1.0])
            area = -area
        scale = np.median(np.abs(area))
        bad = np.flatnonzero(~(area > 1e-9 * scale))
        if len(bad):
            raise InvalidInput(
                "faces",
                got=f"{len(bad)} degenerate or flipped triangles (first: {bad[0]}, area {area[bad[0]]:.3g} m^2)",
                expected="positive area in the rest shape",
            )
        return Mesh(x, f, rest, pattern)

    @property
    def area(self) -> np.ndarray:
        """[F] m^2, rest area of each triangle."""
        return signed_area(self.rest)

    @property
    def shape_gradient(self) -> np.ndarray:
        """[F, 3, 2] 1/m, gradient of each corner's linear shape function in material axes: F = sum_a x_a (x) G_a."""
        edges = np.stack([self.rest[:, 1] - self.rest[:, 0], self.rest[:, 2] - self.rest[:, 0]], axis=-1)
        inverse = np.linalg.inv(edges)  # rows: gradients of the 2nd and 3rd shape function
        return np.concatenate([-inverse.sum(1, keepdims=True), inverse], axis=1)

    @property
    def mean_edge(self) -> float:
        """Mean edge length of the rest shape [m]."""
        return float(np.linalg.norm(self.rest - np.roll(self.rest, 1, axis=1), axis=-1).mean())

    def nearest_vertices(self, uv: ArrayLike, radius: float) -> np.ndarray:
        """Indices of the vertices within ``radius`` [m] of any of the pattern points ``uv`` [G, 2].

        Raises:
            InvalidInput: the mesh has no pattern coordinates, or no vertex lies that near.
        """
        if self.uv is None:
            raise InvalidInput(
                "uv",
                got="a mesh without pattern coordinates",
                expected="a mesh with uv",
                remedy="name the grasped vertices instead",
            )
        distance = np.linalg.norm(self.uv[:, None] - np.atleast_2d(uv)[None], axis=-1).min(1)
        found = np.flatnonzero(distance <= radius * (1 + 1e-9))
        if len(found) == 0:
            raise InvalidInput(
                "grasp",
                got=f"no vertex within {radius:g} m (nearest: {distance.min():.4g} m)",
                expected="a patch that holds at least one vertex",
                remedy="enlarge the radius or refine the mesh",
            )
        return found


def signed_area(rest: np.ndarray) -> np.ndarray:
    """[F] m^2 from corners [F, 3, 2]."""
    a, b = rest[:, 1] - rest[:, 0], rest[:, 2] - rest[:, 0]
    return 0.5 * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def _flatten(corners: np.ndarray) -> np.ndarray:
    """Isometric copies of 3-D triangles [F, 3, 3] in their own planes [F, 3, 2]."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    length = np.linalg.norm(a, axis=-1)
    warp = a / np.maximum(length, np.finfo(float).tiny)[:, None]
    along = (b * warp).sum(-1)
    across = np.linalg.norm(b - along[:, None] * warp, axis=-1)
    zero = np.zeros_like(length)
    return np.stack([np.stack([zero, zero], -1), np.stack([length, zero], -1), np.stack([along, across], -1)], axis=1)
