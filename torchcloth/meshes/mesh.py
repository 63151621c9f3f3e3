"""The triangle mesh of a cloth, and the geometry of its rest shape."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from ..errors import InvalidInput
from . import topology

COINCIDENT_VERTEX_FRACTION = 1e-6  # of the largest extent; nearer vertices lie in the same place
MAX_EVEN_EDGE_RATIO = 1.5  # longest over mean edge of an even mesh; ours have 1.24 to 1.46
# Edges in a pattern over those in the mesh; beyond these ratios the pattern is in another unit.
MAX_PATTERN_EDGE_RATIO = 1.2
MAX_UNIT_SQUARE_EDGE_RATIO = 1.05  # of a pattern that fills the unit square, and so may be a texture
IGNORED_EDGE_FRACTION = 0.1  # at each end of these ratios: edges that are gathered or stretched where the cloth lies
MAX_FLATNESS_RATIO = 20.0  # median height of the triangles over the smallest; ours have 1.6
MIN_CLOTH_SPAN_M = 1e-9  # less is none: ratios of lengths could overflow
MAX_CLOTH_SPAN_M = 20.0  # a longer cloth is taken to be in millimetres
MAX_AREAL_DENSITY_KG_PER_M2 = 20.0  # a heavier cloth is taken to be in g/m^2


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles of a cloth, with positions in the world and a rest shape.

    Attributes:
        vertices: [V, 3] m, positions of the unstrained cloth in the world.
        faces: [F, 3] int64, counter-clockwise as seen from the side of the normal.
        rest: [F, 3, 2] m, corners of each triangle in material axes (warp, weft). Taken from the pattern if there is
            one, with panels drawn from behind turned over; else from the vertices, warp along the first edge.
        pattern: [F, 3, 2] m or None, pattern coordinates (u = warp, v = weft) of each triangle's corners. A vertex on
            a seam belongs to several panels and has coordinates on each.
        places: vertex indices by name, such as "left shoulder", for gripping and measuring.
    """

    vertices: np.ndarray
    faces: np.ndarray
    rest: np.ndarray
    pattern: np.ndarray | None = None
    places: Mapping[str, np.ndarray] = field(default_factory=dict)

    @staticmethod
    def build(
        vertices: ArrayLike,
        faces: ArrayLike,
        uv: ArrayLike | None = None,
        places: Mapping[str, ArrayLike] | None = None,
    ) -> Mesh:
        """Check the arrays, and build a mesh with its rest shape.

        Args:
            vertices: [V, 3] m.
            faces: [F, 3] vertex indices.
            uv: pattern coordinates in metres, [V, 2], or [F, 3, 2] per triangle corner for sewn panels.
            places: vertex indices by name.

        Raises:
            InvalidInput: wrong shapes, indices out of range, unused vertices, degenerate or flipped triangles, more
                than two at an edge.
        """
        x, f = _numbers("vertices", vertices), _indices(_numbers("faces", faces, None))
        _check_triangles(x, f)
        pattern = None if uv is None else _per_corner(_numbers("uv", uv), f, len(x))
        rest = _flatten(x[f]) if pattern is None else _turned_over(f, pattern)
        area = signed_area(rest)
        bad = np.flatnonzero(~(area > 1e-9 * np.median(np.abs(area))))
        if len(bad):
            raise InvalidInput(
                "faces",
                got=f"{len(bad)} degenerate or flipped triangles (first: {bad[0]}, area {area[bad[0]]:.3g} m^2)",
                expected="positive area in the rest shape",
            )
        _check_winding(f)
        _warn_of_flat_triangles(rest)
        named = {name: _check_place(name, np.array(index), len(x)) for name, index in (places or {}).items()}
        return Mesh(x, f, rest, pattern, named)

    def is_equal(self, other: Mesh) -> bool:
        """Return whether vertices, triangles, rest shapes, patterns and places are equal."""
        if self is other:
            return True
        if self.places.keys() != other.places.keys() or (self.pattern is None) is not (other.pattern is None):
            return False
        pairs = [(self.vertices, other.vertices), (self.faces, other.faces), (self.rest, other.rest)]
        pairs += [(index, other.places[name]) for name, index in self.places.items()]
        if self.pattern is not None and other.pattern is not None:
            pairs.append((self.pattern, other.pattern))
        return all(np.array_equal(a, b) for a, b in pairs)

    @property
    def uv(self) -> np.ndarray | None:
        """Pattern coordinates of the vertices, [V, 2] m; None without a pattern, or if a seam gives a vertex two."""
        return None if self.pattern is None else corner_to_vertex_values(self.faces, self.pattern)

    @property
    def seams(self) -> np.ndarray:
        """Edges along which panels are sewn, [N, 2] int64; empty without a pattern."""
        return np.zeros((0, 2), np.int64) if self.pattern is None else topology.find_seams(self.faces, self.pattern)

    @property
    def boundary_edges(self) -> np.ndarray:
        """Free edges (hems), which belong to one triangle only, [N, 2] int64."""
        edges, triangles = topology.find_edges(self.faces)
        return edges[triangles == 1]

    @property
    def panels(self) -> np.ndarray:
        """Number of each triangle's panel before sewing, [F] int64; 0 without a pattern."""
        return (
            np.zeros(len(self.faces), np.int64)
            if self.pattern is None
            else topology.number_panels(self.faces, self.pattern)
        )

    @property
    def is_pattern_from_behind(self) -> np.ndarray:
        """Whether each triangle's pattern is drawn from behind (clockwise), so that ``rest`` mirrors it, [F] bool."""
        return np.zeros(len(self.faces), bool) if self.pattern is None else signed_area(self.pattern) < 0

    @property
    def piece_count(self) -> int:
        """Number of pieces that have no vertex in common."""
        return topology.count_pieces(self.faces)

    @property
    def duplicated_vertex_count(self) -> int:
        """Number of vertices that lie on a vertex of another piece, as where a file splits them by texture."""
        piece = topology.number_pieces(self.faces)
        if piece.max(initial=0) == 0:
            return 0
        used = np.unique(self.faces)
        span = np.ptp(self.vertices, axis=0).max()
        _, place = np.unique(
            np.round(self.vertices[used] / (COINCIDENT_VERTEX_FRACTION * span)).astype(np.int64),
            axis=0,
            return_inverse=True,
        )
        place = place.reshape(-1)
        pairs = np.unique(np.column_stack([place, piece[used]]), axis=0)
        shared = np.bincount(pairs[:, 0]) > 1
        return int(shared[place].sum())

    @property
    def area(self) -> np.ndarray:
        """Rest area of each triangle, [F] m^2."""
        return signed_area(self.rest)

    @property
    def vertex_area(self) -> np.ndarray:
        """Rest area of each vertex, [V] m^2: a third of each of its triangles, as mass is distributed."""
        return np.bincount(self.faces.ravel(), np.repeat(self.area / 3, 3), minlength=len(self.vertices))

    @property
    def shape_gradient(self) -> np.ndarray:
        """Gradients of the corners' linear shape functions in material axes, [F, 3, 2] 1/m: F = sum_a x_a (x) G_a."""
        edges = np.stack([self.rest[:, 1] - self.rest[:, 0], self.rest[:, 2] - self.rest[:, 0]], axis=-1)
        inverse = np.linalg.inv(edges)  # rows: gradients of the 2nd and 3rd shape function
        return np.concatenate([-inverse.sum(1, keepdims=True), inverse], axis=1)

    @property
    def mean_edge(self) -> float:
        """Mean edge length of the rest shape [m]."""
        return float(np.linalg.norm(self.rest - np.roll(self.rest, 1, axis=1), axis=-1).mean())

    @property
    def coarse_edge(self) -> float:
        """Mean edge length [m], or 2/3 of the longest edge where triangles differ much; contact points use it."""
        sides = np.linalg.norm(self.rest - np.roll(self.rest, 1, axis=1), axis=-1)
        return float(max(sides.mean(), sides.max() / MAX_EVEN_EDGE_RATIO))

    @property
    def extent(self) -> float:
        """Longest path [m] along the edges of the rest shape, in any piece, from the vertex farthest from its first.

        The cloth cannot extend farther in any state without strain, up to the zigzag of the edges.
        """
        firsts = topology.find_first_vertices(self.faces)
        starts = (topology.find_farthest_vertex(self.faces, self.rest, int(first))[0] for first in firsts)
        return max(topology.find_farthest_vertex(self.faces, self.rest, start)[1] for start in starts)

    def renumber_along_longest_side(self) -> Mesh:
        """Return the same cloth with vertices and triangles numbered along its longest side.

        Threads divide a cloth by numbers. If neighbours have near numbers, threads wait less for each other.
        """
        along = self.vertices[:, np.ptp(self.vertices, axis=0).argmax()]
        vertices, faces = np.argsort(along, kind="stable"), np.argsort(along[self.faces].sum(1), kind="stable")
        number = np.argsort(vertices)
        return Mesh(
            self.vertices[vertices],
            number[self.faces[faces]],
            self.rest[faces],
            None if self.pattern is None else self.pattern[faces],
            {name: np.sort(number[index]) for name, index in self.places.items()},
        )

    def vertices_near_pattern_points(self, uv: ArrayLike, radius: float) -> np.ndarray:
        """Find the vertices within ``radius`` [m] of any of the pattern points ``uv`` [G, 2] m; return their indices.

        Raises:
            InvalidInput: the mesh has no pattern coordinates, or no vertex lies that near.
        """
        if self.pattern is None:
            raise InvalidInput(
                "uv",
                got="a mesh without pattern coordinates",
                expected="a mesh with uv",
                remedy="name the grasped vertices instead",
            )
        corners, owner = np.unique(
            np.column_stack([self.faces.ravel(), self.pattern.reshape(-1, 2)]), axis=0, return_index=True
        )
        distance = np.linalg.norm(corners[:, None, 1:] - np.atleast_2d(uv)[None], axis=-1).min(1)
        vertices = np.unique(self.faces.ravel()[owner[distance <= radius * (1 + 1e-9)]])
        if len(vertices) == 0:
            raise InvalidInput(
                "grasp",
                got=f"no vertex within {radius:g} m (nearest: {distance.min():.4g} m)",
                expected="a patch that holds at least one vertex",
                remedy="enlarge the radius or refine the mesh",
            )
        return vertices

    def vertices_at_place(self, place: str, radius: float = 0.0) -> np.ndarray:
        """Find the vertices of a named place, and those within ``radius`` [m] of it in space; return their indices.

        The radius reaches through layers that lie on each other, as a gripper that pinches them does.

        Raises:
            InvalidInput: the mesh has no place of that name, or a radius that is negative.
        """
        if not radius >= 0:
            raise InvalidInput("radius", got=f"{radius} m", expected="a length >= 0")
        if place not in self.places:
            raise InvalidInput(
                "place",
                got=repr(place),
                expected=f"one of {', '.join(self.places)}" if self.places else "a mesh with named places",
                remedy="" if self.places else "name the grasped vertices instead",
            )
        centres = self.vertices[self.places[place]]
        distance = np.linalg.norm(self.vertices[:, None] - centres[None], axis=-1).min(1)
        return np.flatnonzero(distance <= radius * (1 + 1e-9))


def signed_area(rest: np.ndarray) -> np.ndarray:
    """Compute signed areas [F] m^2 of triangles with corners [F, 3, 2] m."""
    a, b = rest[:, 1] - rest[:, 0], rest[:, 2] - rest[:, 0]
    return 0.5 * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def check_metres(vertices: np.ndarray, faces: np.ndarray, corners: np.ndarray | None, place: str) -> None:
    """Check that a file's vertices, and its pattern coordinates [F, 3, 2], are in metres.

    However the cloth lies, folded or sewn, its edges are about as long as in its pattern. Edges in a texture are not,
    unless by chance, so a pattern that fills the unit square must agree more closely.

    Raises:
        InvalidInput: no span, one beyond MAX_CLOTH_SPAN_M, or a pattern whose edges have other lengths.
    """
    span = float(np.ptp(vertices, axis=0).max())
    if span > MAX_CLOTH_SPAN_M:
        got, remedy = f"a span of {span:.4g}", "multiply by 0.001"
        raise InvalidInput(f"{place} looks like millimetres", got=got, expected="metres", remedy=remedy)
    if not span > MIN_CLOTH_SPAN_M:
        raise InvalidInput(f"{place} has no extent", got=f"a span of {span:.4g} m", expected="a cloth")
    if corners is None:
        return
    pattern, lying = (np.linalg.norm(c - np.roll(c, 1, axis=1), axis=-1).ravel() for c in (corners, vertices[faces]))
    low, high = np.quantile(
        pattern / np.maximum(lying, 1e-9 * span), (IGNORED_EDGE_FRACTION, 1 - IGNORED_EDGE_FRACTION)
    )
    square = np.allclose([corners.min((0, 1)), corners.max((0, 1))], [[0, 0], [1, 1]], rtol=0, atol=1e-3)
    limit = MAX_UNIT_SQUARE_EDGE_RATIO if square else MAX_PATTERN_EDGE_RATIO
    if not 1 / limit < low <= high < limit:
        raise InvalidInput(
            f"{place}: vt",
            got=f"edges in the pattern {low:.3g} to {high:.3g} times as long as in the mesh",
            expected="about the same",
            remedy="vt must be in metres: scale it, or export without texture coordinates",
        )


def corner_to_vertex_values(faces: np.ndarray, corners: np.ndarray) -> np.ndarray | None:
    """Return vertex values [V, D] from corner values [F, 3, D], or None where a vertex has several."""
    values = np.zeros((faces.max() + 1, corners.shape[-1]))
    values[faces] = corners
    return values if np.array_equal(values[faces], corners) else None


def _numbers(name: str, given: ArrayLike, dtype: type | None = np.float64) -> np.ndarray:
    """Return a copy as an array; gradients do not pass through a mesh."""
    try:
        return np.asarray(given, dtype=dtype).copy()
    except (TypeError, ValueError, RuntimeError) as error:
        expected = "a rectangular array of numbers; triangles, of faces"
        raise InvalidInput(name, got=f"{type(given).__name__} ({error})"[:120], expected=expected) from error


def _indices(faces: np.ndarray) -> np.ndarray:
    """Return faces as integers; refuse numbers that are not whole."""
    if faces.dtype.kind not in "iu" and (faces.dtype.kind != "f" or not np.array_equal(faces, np.trunc(faces))):
        raise InvalidInput("faces", got=f"numbers of {faces.dtype}", expected="vertex indices [F, 3]")
    return faces.astype(np.int64)


def _check_triangles(x: np.ndarray, f: np.ndarray) -> None:
    if x.ndim != 2 or x.shape[1] != 3 or not np.isfinite(x).all():
        raise InvalidInput("vertices", got=f"shape {x.shape}", expected="finite [V, 3] in metres")
    if f.ndim != 2 or f.shape[1] != 3 or len(f) == 0:
        raise InvalidInput("faces", got=f"shape {f.shape}", expected="[F, 3] vertex indices, F > 0")
    if f.min() < 0 or f.max() >= len(x):
        raise InvalidInput(
            "faces", got=f"indices {f.min()}..{f.max()}", expected=f"0..{len(x) - 1}, one per row of vertices"
        )
    folded = np.flatnonzero((f == np.roll(f, 1, axis=1)).any(1))
    if len(folded):
        got = f"{len(folded)} with a vertex twice (first: {folded[0]}: {f[folded[0]].tolist()})"
        raise InvalidInput("faces", got=got, expected="three different vertices each", remedy="remove them")
    unused = np.setdiff1d(np.arange(len(x)), f)
    if len(unused):
        raise InvalidInput(
            "vertices",
            got=f"{len(unused)} in no triangle (first: {unused[0]})",
            expected="every vertex in a triangle",
            remedy="a vertex without area has no mass; remove it",
        )


def _warn_of_flat_triangles(rest: np.ndarray) -> None:
    """Warn of triangles [F, 3, 2] m that are much flatter than most: the stable step is in proportion to the height."""
    longest = np.linalg.norm(rest - np.roll(rest, 1, axis=1), axis=-1).max(1)
    height = 2 * np.abs(signed_area(rest)) / longest
    typical, flattest = float(np.median(height)), int(np.argmin(height))
    count = int((height * MAX_FLATNESS_RATIO < typical).sum())
    if count:
        ratio = typical / height[flattest]
        more = f" ({count - 1} more are over {MAX_FLATNESS_RATIO:g} times flatter)" if count > 1 else ""
        warnings.warn(
            f"triangle {flattest} is {ratio:.0f} times flatter than the median, {1e3 * height[flattest]:.2g} mm "
            f"high{more}; the stable step becomes up to {ratio:.0f} times shorter: remesh, or merge its vertices",
            stacklevel=3,
        )


def _check_winding(f: np.ndarray) -> None:
    bad = topology.find_inconsistent_sides(f)
    if len(bad):
        raise InvalidInput(
            "faces",
            got=f"{len(bad)} edges along which two triangles go the same way (first: {bad[0].tolist()})",
            expected="neighbours that turn alike, at most two at an edge",
            remedy="orient the faces alike; fins and pockets are cloths of their own",
        )


def _per_corner(uv: np.ndarray, faces: np.ndarray, count: int) -> np.ndarray:
    if uv.shape not in ((count, 2), (*faces.shape, 2)) or not np.isfinite(uv).all():
        raise InvalidInput(
            "uv",
            got=f"shape {uv.shape}",
            expected=f"finite [{count}, 2] or, per corner, [{len(faces)}, 3, 2] in metres",
        )
    return uv if uv.ndim == 3 else uv[faces]


def _check_place(name: str, index: np.ndarray, count: int) -> np.ndarray:
    if index.ndim != 1 or not len(index) or index.dtype.kind not in "iu" or index.min() < 0 or index.max() >= count:
        raise InvalidInput(
            f"places[{name!r}]", got=f"{index.tolist()}", expected=f"a list of vertex indices in 0..{count - 1}"
        )
    return index.astype(np.int64)


def _turned_over(faces: np.ndarray, pattern: np.ndarray) -> np.ndarray:
    """Return the pattern with every panel that is drawn from behind mirrored: the same cloth, other side up."""
    area = signed_area(pattern)
    if (area > 0).all():
        return pattern
    panel = topology.number_panels(faces, pattern)
    behind = np.bincount(panel, area >= 0) == 0
    return np.where(behind[panel][:, None, None], pattern * np.array([-1.0, 1.0]), pattern)


def _flatten(corners: np.ndarray) -> np.ndarray:
    """Return isometric copies of 3-D triangles [F, 3, 3] in their own planes, [F, 3, 2]."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    length = np.linalg.norm(a, axis=-1)
    warp = a / np.maximum(length, np.finfo(float).tiny)[:, None]
    along = (b * warp).sum(-1)
    across = np.linalg.norm(b - along[:, None] * warp, axis=-1)
    zero = np.zeros_like(length)
    return np.stack([np.stack([zero, zero], -1), np.stack([length, zero], -1), np.stack([along, across], -1)], axis=1)


def vertex_normals(x: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Compute unit normals at the vertices, [V, 3]: the mean of the adjacent triangles, weighted by area."""
    a, b, c = x[faces[:, 0]], x[faces[:, 1]], x[faces[:, 2]]
    total = np.zeros_like(x)
    np.add.at(total, faces, np.cross(b - a, c - a)[:, None])
    return total / np.maximum(np.linalg.norm(total, axis=-1, keepdims=True), 1e-12)
