"""Derivatives of a field on a triangle mesh in material axes, as constant stencils."""

from __future__ import annotations

import cmath
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from ..meshes import Mesh

MAX_RING_GROWTHS = 3  # rings of triangles that may be added to a vertex's own ring
MIN_SINGULAR_VALUE_RATIO = 0.15  # smallest over largest singular value of a fit that needs no more neighbours


class CurvatureStencils(NamedTuple):
    """Derivatives of a field f at every vertex v: sum_n weight_n (f_n - f_v).

    Attributes:
        neighbours: [V, N] int; rows are padded with v, at weight 0.
        second: [V, N, 3] 1/m^2, weights of the second derivatives along ww, ff, and sqrt 2 times wf.
        first: [V, N, 2] 1/m, weights of the first derivatives along w and f.
    """

    neighbours: np.ndarray
    second: np.ndarray
    first: np.ndarray


@lru_cache(maxsize=8)  # variants of a model share their mesh
def curvature_stencils(mesh: Mesh) -> CurvatureStencils:
    """Compute stencils of the first and second derivatives at every vertex. Do not write to the result: it is cached.

    They come from a least-squares quadratic through the vertex over its ring, weighted by 1 / distance^4 (residuals
    count as the curvature they make). Where the ring does not determine the quadratic (rim, valence 4), it grows by the
    triangles beyond its edges. What stays undetermined (a strip of one cell) is taken as 0. Quadratics are
    differentiated exactly, and linear functions give 0 on any mesh.

    The ring is unfolded by laying the triangles' rest shapes edge to edge, so seams and folded garments are no special
    case. Axes are those of the vertex's first triangle.
    """
    rings = _determining_rings(mesh)
    depth = max(map(len, rings))
    stencil = np.repeat(np.arange(len(rings))[:, None], depth, axis=1)
    weight = np.zeros((len(rings), depth, 5))
    for group, places in _group_by_size(rings):
        size = places.shape[1]
        stencil[group, :size], weight[group, :size] = [list(rings[v]) for v in group], _fit(places)
    return CurvatureStencils(stencil, weight[..., :3], weight[..., 3:])


def mixed_area(mesh: Mesh) -> np.ndarray:
    """Compute the mixed Voronoi area of each vertex, [V] m^2, safe for obtuse triangles (Meyer et al. 2003).

    Thirds of the triangles would make the curvature energy depend on each vertex's valence.
    """
    cotangent = _cotangents(mesh)
    area = np.zeros(len(mesh.vertices))
    for corner in range(3):
        b, c = (corner + 1) % 3, (corner + 2) % 3
        ab = ((mesh.rest[:, b] - mesh.rest[:, corner]) ** 2).sum(-1)
        ac = ((mesh.rest[:, c] - mesh.rest[:, corner]) ** 2).sum(-1)
        voronoi = (ab * cotangent[:, c] + ac * cotangent[:, b]) / 8
        obtuse = (cotangent < 0).any(1)
        share = np.where(obtuse, mesh.area * np.where(cotangent[:, corner] < 0, 0.5, 0.25), voronoi)
        np.add.at(area, mesh.faces[:, corner], share)
    return area


class SparsityPattern(NamedTuple):
    """Non-zero entries of a matrix that couples the vertices of each stencil, by rows.

    Attributes:
        columns: [V, D] int, padded with the row itself.
        slots: [V, N + 1, N + 1] int, position of each stencil's local entry in the flat columns; V D for none.
    """

    columns: np.ndarray
    slots: np.ndarray


def find_sparsity_pattern(near: np.ndarray, local: np.ndarray) -> SparsityPattern:
    """Find the entries that are not negligible in the sum of local matrices [V, N + 1, N + 1], the vertex first.

    The diagonal is left out: rows sum to zero, so (Q f)_i = sum_d entry_id (f_d - f_i).
    """
    count = len(near)
    nodes = np.concatenate([np.arange(count)[:, None], near], axis=1)
    key = (nodes[:, :, None] * count + nodes[:, None, :]).ravel()
    key, inverse = np.unique(key, return_inverse=True)
    entry = np.bincount(inverse.ravel(), weights=local.ravel())
    row, column = key // count, key % count
    is_entry = (row != column) & (np.abs(entry) > 1e-12 * np.abs(entry).max())
    length = np.bincount(row[is_entry], minlength=count)
    place = np.arange(is_entry.sum()) - np.repeat(np.cumsum(length) - length, length)
    columns = np.repeat(np.arange(count)[:, None], max(1, length.max(initial=0)), axis=1)
    columns[row[is_entry], place] = column[is_entry]
    slot = np.full(len(key), columns.size)
    slot[is_entry] = row[is_entry] * columns.shape[1] + place
    return SparsityPattern(columns, slot[inverse.ravel()].reshape(local.shape))


def sum_entries(shape: SparsityPattern, local: np.ndarray) -> np.ndarray:
    """Sum the local matrices, and return the off-diagonal entries [V, D]."""
    flat = np.bincount(shape.slots.ravel(), weights=local.ravel(), minlength=shape.columns.size + 1)
    return flat[:-1].reshape(shape.columns.shape)


def local_matrices(form: np.ndarray, other: np.ndarray | None = None) -> np.ndarray:
    """Return the matrices [V, N + 1, N + 1] of products of linear forms [V, N, C].

    They represent sum_c (sum_n form_nc (f_n - f_v)) (sum_n other_nc (f_n - f_v)); ``other`` defaults to ``form``.
    """
    full, second = (
        np.concatenate([-part.sum(1, keepdims=True), part], axis=1) for part in (form, form if other is None else other)
    )
    return full @ second.swapaxes(1, 2)


def largest_eigenvalue(columns: np.ndarray, entries: np.ndarray, mass: np.ndarray, steps: int = 300) -> float:
    """Bound the largest eigenvalue of Q f = lambda mass f from above.

    By power iteration, whose expected relative error is below ln V / steps, plus 5 %.
    """
    root = 1 / np.sqrt(mass)
    diagonal = -entries.sum(1)
    f = np.random.default_rng(0).standard_normal(len(mass))
    value = 0.0
    for _ in range(steps):
        f /= np.linalg.norm(f)
        g = root * f
        image = root * ((entries * g[columns]).sum(1) + diagonal * g)
        value, f = float(f @ image), image
        if value == 0.0:
            break
    return 1.05 * value


def _triangles_beyond(mesh: Mesh) -> dict[tuple[int, int], tuple[int, complex]]:
    """Return by directed edge (p, q) of a triangle its third vertex r, and (r - p) / (q - p) in the rest plane.

    Complex numbers are points of the plane: multiplying by the ratio lays the triangle against a given edge.
    """
    rest = mesh.rest[..., 0] + 1j * mesh.rest[..., 1]
    out = {}
    for k in range(3):
        p, q, r = k, (k + 1) % 3, (k + 2) % 3
        ratio = (rest[:, r] - rest[:, p]) / (rest[:, q] - rest[:, p])
        out.update(
            zip(
                map(tuple, mesh.faces[:, [p, q]].tolist()),
                zip(mesh.faces[:, r].tolist(), ratio.tolist(), strict=True),
                strict=True,
            )
        )
    return out


def _spokes(mesh: Mesh) -> list[dict[int, complex]]:
    """Return for each vertex its edges that start a triangle, in that triangle's material axes."""
    rest = mesh.rest[..., 0] + 1j * mesh.rest[..., 1]
    out: list[dict[int, complex]] = [{} for _ in mesh.vertices]
    for k in range(3):
        edge = rest[:, (k + 1) % 3] - rest[:, k]
        for v, a, z in zip(mesh.faces[:, k].tolist(), mesh.faces[:, (k + 1) % 3].tolist(), edge.tolist(), strict=True):
            out[v][a] = z
    return out


def _ring(v: int, spokes: dict[int, complex], beyond) -> dict[int, complex]:
    """Return the neighbours of ``v`` in order, unfolded about it; angles of a closed ring are scaled to be flat."""
    rims = [a for a in spokes if (a, v) not in beyond]
    fans = [_fan(v, start, beyond) for start in rims or [next(iter(spokes))]]
    ring, ratios, closed = max(fans, key=lambda fan: len(fan[0]))  # one of those that only touch at the vertex
    turn = 2 * cmath.pi / sum(map(cmath.phase, ratios)) if closed else 1.0
    place = {ring[0]: spokes[ring[0]]}
    for before, after, ratio in zip(ring, ring[1:], ratios, strict=False):
        place[after] = place[before] * cmath.rect(abs(ratio), turn * cmath.phase(ratio))
    return place


def _fan(v: int, start: int, beyond) -> tuple[list[int], list[complex], bool]:
    """Return neighbours counter-clockwise from ``start``, the ratios between them, and whether they close a ring."""
    ring, ratios = [start], []
    while (v, ring[-1]) in beyond:
        after, ratio = beyond[v, ring[-1]]
        ratios.append(ratio)
        if after in ring:
            return ring, ratios, after == start
        ring.append(after)
    return ring, ratios, False


def _determining_rings(mesh: Mesh) -> list[dict[int, complex]]:
    """Return unfolded neighbours of each vertex, enough for a quadratic if the mesh has them."""
    beyond = _triangles_beyond(mesh)
    rings = [_ring(v, spokes, beyond) for v, spokes in enumerate(_spokes(mesh))]
    edges = [[(a, beyond[v, a][0]) for a in ring if (v, a) in beyond] for v, ring in enumerate(rings)]
    undetermined = np.arange(len(rings))
    for _ in range(MAX_RING_GROWTHS):
        groups = _group_by_size([rings[v] for v in undetermined])
        parts = [undetermined[group[~_determines_quadratic(places)]] for group, places in groups]
        undetermined = np.concatenate([*parts, undetermined[:0]])
        for v in undetermined.tolist():
            edges[v], rings[v] = _grown(edges[v], {v: 0j, **rings[v]}, beyond)
            del rings[v][v]
    return rings


def _group_by_size(rings: list[dict[int, complex]]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return groups of equally large rings: their indices [B], and the places of their neighbours [B, N]."""
    sizes = np.array([len(ring) for ring in rings], dtype=int)
    groups = [np.flatnonzero(sizes == size) for size in np.unique(sizes)]
    return [(group, np.array([list(rings[v].values()) for v in group])) for group in groups]


def _determines_quadratic(places: np.ndarray) -> np.ndarray:
    """Return whether each ring of ``places`` [B, N] determines a quadratic.

    The linear part is taken out of the quadratic terms first. That keeps linear functions free of curvature where the
    quadratic is undetermined.
    """
    _, _, quadratic, project, _ = _split(places)
    singular = np.linalg.svd(project @ quadratic, compute_uv=False)
    if singular.shape[1] < 3:
        return np.zeros(len(places), bool)
    return singular[:, 2] > MIN_SINGULAR_VALUE_RATIO * singular[:, 0]


def _grown(edges: list[tuple[int, int]], place: dict[int, complex], beyond):
    """The patch with the triangles beyond its outer edges laid against them."""
    place, outer = dict(place), []
    for a, b in edges:
        if (b, a) in beyond:
            c, ratio = beyond[b, a]
            place.setdefault(c, place[b] + ratio * (place[a] - place[b]))
            outer += [(a, c), (c, b)]
    return outer, place


def _split(places: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return what fits quadratics to values at places [B, N].

    It is the weights of the rows [B, N], what maps weighted values to the linear part [B, 2, N], quadratic columns
    [B, N, 3] unweighted, what maps values to the weighted remainder [B, N, N], and units of length [B].
    """
    length = np.abs(places).mean(1)
    x, y = np.real(places) / length[:, None], np.imag(places) / length[:, None]
    root = 1 / (x * x + y * y)
    linear = root[..., None] * np.stack([x, y], axis=-1)
    slope = np.linalg.pinv(linear)
    project = (np.eye(places.shape[1]) - linear @ slope) * root[:, None]
    # with sqrt 2 wf as the third unknown, turned material axes turn the unknowns: the fit does not depend on them
    return root, slope, np.stack([x * x / 2, y * y / 2, x * y / 2**0.5], axis=-1), project, length


def _fit(places: np.ndarray) -> np.ndarray:
    """Return the weights [B, N, 5] of neighbours at places [B, N]: of the second derivatives, then of the first."""
    root, slope, quadratic, project, length = _split(places)
    left, singular, right = np.linalg.svd(project @ quadratic, full_matrices=False)
    is_determined = (
        singular > MIN_SINGULAR_VALUE_RATIO / 20 * places.shape[1] ** 0.5
    )  # before the linear part went, every row had length 1/2
    inverse = np.where(is_determined, 1 / np.where(is_determined, singular, 1.0), 0.0)
    second = (right.swapaxes(1, 2) * inverse[:, None]) @ left.swapaxes(1, 2) @ project
    first = (slope * root[:, None]) @ (np.eye(places.shape[1]) - quadratic @ second)
    length = length[:, None, None]
    return np.concatenate([second / length**2, first / length], axis=1).swapaxes(1, 2)


def _cotangents(mesh: Mesh) -> np.ndarray:
    """Return the cotangents of the rest angles at the corners, [F, 3]."""
    out = np.zeros((len(mesh.faces), 3))
    for corner in range(3):
        a = mesh.rest[:, (corner + 1) % 3] - mesh.rest[:, corner]
        b = mesh.rest[:, (corner + 2) % 3] - mesh.rest[:, corner]
        out[:, corner] = (a * b).sum(-1) / (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    return out
