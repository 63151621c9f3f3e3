"""Triangulation of a flat outline by triangles of even size and good shape."""

from __future__ import annotations

import numpy as np

from ..errors import InvalidInput
from . import topology

MIN_RIM_DISTANCE_EDGES = 0.6  # in edge lengths, between the outline and the first inner points
SPRING_ROUNDS = 60
SPRING_LENGTH_RATIO = 1.15  # length at which springs stop pushing, over the mean edge
SPRING_STEP_FRACTION = 0.2  # of the push, by which points move in a round


def sample_polyline(curve: np.ndarray, edge: float) -> np.ndarray:
    """Place points [N, 2] on a polyline [K, 2] in equal steps of about ``edge``, with both ends exact."""
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    stops = np.linspace(0.0, length[-1], max(1, round(length[-1] / edge)) + 1)
    points = np.stack([np.interp(stops, length, curve[:, k]) for k in range(2)], axis=1)
    points[0], points[-1] = curve[0], curve[-1]
    return points


def triangulate_outline(outline: np.ndarray, edge: float) -> tuple[np.ndarray, np.ndarray]:
    """Triangulate an outline.

    A hexagonal lattice whose edges act as springs that push (Persson and Strang 2004, "A simple mesh generator in
    MATLAB", with the outline held): smallest angles come out above 30 degrees where Laplacian smoothing leaves 23.

    Args:
        outline: [B, 2] m, counter-clockwise, already in steps of about ``edge``.
        edge: wanted edge length [m].

    Returns:
        Points [N, 2] m, those of the outline first; and triangles [F, 3], counter-clockwise.

    Raises:
        InvalidInput: an outline that crosses itself, or is too narrow for the edge.
    """
    from matplotlib.path import Path

    low, high = outline.min(0), outline.max(0)
    lattice = _hexagons(low, high, edge)
    inner = lattice[Path(outline).contains_points(lattice)]
    if len(inner):
        inner = inner[distance_to_path(inner, np.vstack([outline, outline[:1]])) > MIN_RIM_DISTANCE_EDGES * edge]
    points = np.vstack([outline, inner])
    triangles = _delaunay(points, outline, edge)
    for _ in range(SPRING_ROUNDS):
        points = _spread(points, triangles, len(outline))
        triangles = _delaunay(points, outline, edge)
    _check_outline(triangles, len(outline))
    return points, triangles


def distance_to_path(points: np.ndarray, path: np.ndarray) -> np.ndarray:
    """Compute the distances [N] m of points [N, 2] from the nearest point of a polyline [K, 2]."""
    start, along = path[:-1], np.diff(path, axis=0)
    offset = points[:, None] - start
    t = np.clip((offset * along).sum(-1) / (along**2).sum(-1), 0.0, 1.0)
    return np.linalg.norm(offset - t[..., None] * along, axis=-1).min(1)


def _hexagons(low: np.ndarray, high: np.ndarray, edge: float) -> np.ndarray:
    """Return points [N, 2] of a hexagonal lattice that is centred on the box."""
    columns, rows = (int(n) // 2 + 1 for n in (high - low) / edge / [1.0, 0.75**0.5])
    i, j = np.meshgrid(np.arange(-columns, columns + 1), np.arange(-rows, rows + 1), indexing="ij")
    lattice = np.stack([i + 0.5 * (j % 2), 0.75**0.5 * j], axis=-1).reshape(-1, 2)
    return (low + high) / 2 + edge * lattice


def _delaunay(points: np.ndarray, outline: np.ndarray, edge: float) -> np.ndarray:
    """Return Delaunay triangles [F, 3] inside the outline, without the slivers of points in a row."""
    from matplotlib.path import Path
    from matplotlib.tri import Triangulation

    triangles = Triangulation(*points.T).triangles.astype(np.int64)
    a, b, c = (points[triangles[:, k]] for k in range(3))
    area = 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    triangles[area < 0] = triangles[area < 0][:, ::-1]
    inside = Path(outline).contains_points((a + b + c) / 3) & (np.abs(area) > 1e-3 * edge**2)
    return triangles[inside]


def _spread(points: np.ndarray, triangles: np.ndarray, fixed: int) -> np.ndarray:
    """Return the points after springs along the edges have pushed those after the first ``fixed``."""
    ends, _ = topology.find_edges(triangles)
    along = points[ends[:, 1]] - points[ends[:, 0]]
    length = np.linalg.norm(along, axis=1, keepdims=True)
    push = np.maximum(SPRING_LENGTH_RATIO * (length**2).mean() ** 0.5 - length, 0.0) * along / length
    moved = points.copy()
    np.add.at(moved, ends[:, 1], SPRING_STEP_FRACTION * push)
    np.add.at(moved, ends[:, 0], -SPRING_STEP_FRACTION * push)
    moved[:fixed] = points[:fixed]
    return moved


def _check_outline(triangles: np.ndarray, count: int) -> None:
    """Check that the rim is the outline; else it crosses itself, or parts of it are nearer than an edge."""
    sides, uses = topology.find_edges(triangles)
    rim = np.sort(np.stack([np.arange(count), np.roll(np.arange(count), -1)], axis=1), axis=1)
    if not np.array_equal(sides[uses == 1], np.unique(rim, axis=0)):
        raise InvalidInput(
            "panel",
            got="an outline that the triangles do not follow",
            expected="measures that give a simple outline, nowhere narrower than a triangle",
            remedy="check the measures, or ask for more triangles",
        )
