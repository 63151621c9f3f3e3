"""Sewing: from a flat drawing of half a garment to a mesh, mirrored, doubled into front and back, welded at seams."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..errors import InvalidInput
from . import topology
from .mesh import Mesh
from .triangulation import distance_to_path, sample_polyline, triangulate_outline

PANEL_MARGIN_M = 0.05  # between panels on the pattern
# In gaps, the distance r from a seam over which the layers part. The placement strains the cloth by 1 / (2 (2 r)^2).
LIFT_RAMP_GAPS = 6.0
MAX_EDGE_LENGTH_TRIALS = 8  # to reach the wanted number of triangles
TRIANGLE_COUNT_TOLERANCE = 0.03  # relative

Kind = Literal[
    "sewn",  # front to back
    "joined",  # to the next panel of the same layer
    "fold",  # on the middle line, within one panel
    "open",  # a hem
]


@dataclass(frozen=True)
class Curve:
    """A line of the drawing, with points [K, 2] m, x >= 0."""

    kind: Kind
    points: np.ndarray


@dataclass(frozen=True)
class Piece:
    """A panel of the drawing: its curves counter-clockwise ("-name" is backwards), and the direction of its warp."""

    curves: tuple[str, ...]
    warp: tuple[float, float] = (0.0, 1.0)


@dataclass(frozen=True)
class Drawing:
    """The half x >= 0 of a garment that lies flat, front up; ``corners`` names ends: (curve, 0 or -1)."""

    curves: Mapping[str, Curve]
    pieces: Mapping[str, Piece]
    corners: Mapping[str, tuple[str, int]]


@dataclass(frozen=True)
class _Flat:
    """Both halves of one layer.

    Attributes:
        points: [N, 2] m.
        faces: [F, 3] counter-clockwise.
        panel: [F], panel of each triangle.
        warp: [P, 2] unit vectors, warp of each panel.
        curve_points: (side, curve) -> numbers of its points in order.
    """

    points: np.ndarray
    faces: np.ndarray
    panel: np.ndarray
    warp: np.ndarray
    curve_points: dict[tuple[str, str], np.ndarray]


def sew(drawing: Drawing, triangles: int, gap: float) -> Mesh:
    """Sew a drawing to a mesh of about ``triangles`` triangles, with its layers ``gap`` m apart.

    Raises:
        InvalidInput: measures or a number of triangles that give no sound mesh.
    """
    if not (gap >= 0 and np.isfinite(gap)):
        raise InvalidInput("gap", got=f"{gap:g} m", expected="a length >= 0")
    flat = _flatten(drawing, triangles)
    sewn = {name for name, curve in drawing.curves.items() if curve.kind == "sewn"}
    shared = np.zeros(len(flat.points), bool)
    for (_, name), index in flat.curve_points.items():
        shared[index] |= name in sewn
    # back_vertex[i]: number of the back layer's vertex behind vertex i of the front layer; at seams both are one
    back_vertex = np.where(shared, np.arange(len(shared)), len(shared) + np.cumsum(~shared) - 1)
    faces = np.vstack([flat.faces, back_vertex[flat.faces][:, ::-1]])
    if (topology.find_edges(faces)[1] > 2).any():
        raise InvalidInput("triangles", got=triangles, expected="more, for these measures: a part is one triangle wide")
    heights = _layer_heights(flat, sewn, gap)
    front = np.column_stack([flat.points, heights])
    vertices = np.vstack([front, (front * [1.0, 1.0, -1.0])[~shared]])
    vertices[:, :2] -= (vertices[:, :2].min(0) + vertices[:, :2].max(0)) / 2
    return Mesh.build(
        vertices, faces, _lay_out_pattern(flat), _named_vertices(drawing, flat, back_vertex)
    ).renumber_along_longest_side()


def _flatten(drawing: Drawing, triangles: int) -> _Flat:
    """Search for the edge length with which both layers together have the wanted number of triangles."""
    if triangles < 1:
        raise InvalidInput("triangles", got=triangles, expected="a positive number")
    area = _check_drawing(drawing)
    edge, halves = (4 * area / triangles / (0.75**0.5 / 2)) ** 0.5, []
    for _ in range(MAX_EDGE_LENGTH_TRIALS):
        halves.append(_triangulate_half(drawing, edge))
        count = 4 * len(halves[-1].faces)
        if abs(count / triangles - 1) < TRIANGLE_COUNT_TOLERANCE:
            break
        edge *= (count / triangles) ** 0.5
    return _mirror(drawing, min(halves, key=lambda half: abs(4 * len(half.faces) - triangles)))


def _triangulate_half(drawing: Drawing, edge: float) -> _Flat:
    """Triangulate the half that is drawn, and join its pieces."""
    samples = {name: sample_polyline(curve.points, edge) for name, curve in drawing.curves.items()}
    parts, faces, panel, start = [], [], [], 0
    for number, piece in enumerate(drawing.pieces.values()):
        outline = [samples[c.removeprefix("-")][:: -1 if c[0] == "-" else 1][:-1] for c in piece.curves]
        points, inside = triangulate_outline(np.vstack(outline), edge)
        parts.append(points)
        faces.append(inside + start)
        panel += [number] * len(inside)
        start += len(points)
    points, index = _weld(np.vstack(parts))
    curve_points = {("right", name): _find(points, samples[name]) for name in samples}
    warp = np.array([piece.warp for piece in drawing.pieces.values()])
    warp /= np.linalg.norm(warp, axis=1, keepdims=True)
    return _Flat(points, index[np.vstack(faces)], np.array(panel), warp, curve_points)


def _mirror(drawing: Drawing, half: _Flat) -> _Flat:
    """Return both halves, welded on the middle line; a piece with a fold is one panel, others become two."""
    flip = np.array([-1.0, 1.0])
    points, index = _weld(np.vstack([half.points, half.points * flip]))
    right, left = np.split(index, 2)
    folded = [
        any(drawing.curves[c.removeprefix("-")].kind == "fold" for c in p.curves) for p in drawing.pieces.values()
    ]
    other = np.where(np.array(folded)[half.panel], half.panel, half.panel + len(folded))
    curve_points = {("right", name): right[i] for (_, name), i in half.curve_points.items()}
    curve_points |= {("left", name): left[i] for (_, name), i in half.curve_points.items()}
    return _Flat(
        points,
        np.vstack([right[half.faces], left[half.faces][:, ::-1]]),
        np.concatenate([half.panel, other]),
        np.vstack([half.warp, half.warp * flip]),
        curve_points,
    )


def _lay_out_pattern(flat: _Flat) -> np.ndarray:
    """Return the pattern [2 F, 3, 2] m: panels next to each other as they are cut, outer side up, warp along u."""
    layers, start = [], 0.0
    for side, order in ((1.0, [0, 1, 2]), (-1.0, [2, 1, 0])):
        layer = np.zeros((len(flat.faces), 3, 2))
        for panel, warp in enumerate(flat.warp):
            in_panel = flat.panel == panel
            if in_panel.any():
                laid = flat.points @ np.stack([warp, side * np.array([-warp[1], warp[0]])], axis=1)
                laid = laid[flat.faces[in_panel][:, order]]
                layer[in_panel] = laid - laid.min((0, 1)) + [0.0, start]
                start = layer[in_panel][..., 1].max() + PANEL_MARGIN_M
        layers.append(layer)
    return np.concatenate(layers)


def _layer_heights(flat: _Flat, sewn: set[str], gap: float) -> np.ndarray:
    """Return the height of the front layer, [N] m: 0 at seams, half the gap far from them."""
    if gap == 0:
        return np.zeros(len(flat.points))
    seams = [flat.points[index] for (_, name), index in flat.curve_points.items() if name in sewn]
    distance = np.min([distance_to_path(flat.points, seam) for seam in seams], axis=0)
    return gap / 2 * np.minimum(1.0, distance / (LIFT_RAMP_GAPS * gap))


def _named_vertices(drawing: Drawing, flat: _Flat, back_vertex: np.ndarray) -> dict[str, np.ndarray]:
    """Return corners, openings and seams by name; those that meet their mirror image are one, also by layer."""
    out = {}
    for name, (curve, end) in drawing.corners.items():
        out |= {f"{side} {name}": flat.curve_points[side, curve][[end]] for side in ("left", "right")}
    for curve, drawn in drawing.curves.items():
        name = curve if drawn.kind == "open" else f"{curve} seam"
        left, right = flat.curve_points["left", curve], flat.curve_points["right", curve]
        if drawn.kind == "fold":
            continue
        if drawn.kind != "sewn" and len(np.intersect1d(left, right)):
            both_sides = np.union1d(left, right)
            out |= {name: np.union1d(both_sides, back_vertex[both_sides])}
            out |= {f"{name} front": both_sides, f"{name} back": np.unique(back_vertex[both_sides])}
        else:
            out |= {
                f"left {name}": np.union1d(left, back_vertex[left]),
                f"right {name}": np.union1d(right, back_vertex[right]),
            }
    return out


def _check_drawing(drawing: Drawing) -> float:
    """Return the drawing's area [m^2]; refuse pieces that turn over, cross the middle or lie on each other."""
    from matplotlib.path import Path

    outlines = {
        name: np.vstack([_directed_curve(drawing, c) for c in piece.curves]) for name, piece in drawing.pieces.items()
    }
    areas = {name: _area(outline) for name, outline in outlines.items()}
    for name, outline in outlines.items():
        fault = None
        if areas[name] <= 0:
            fault = "no area"
        elif outline[:, 0].min() < 0:
            fault = "crosses the garment's middle line"
        for other, points in outlines.items():
            inside = points[Path(outline).contains_points(points)]
            if other != name and (distance_to_path(inside, np.vstack([outline, outline[:1]])) > 1e-6).any():
                fault = f"the {other} overlaps it"
        if fault:
            raise InvalidInput(
                f"the garment's {name}", got=fault, expected="panels side by side", remedy="check the measures"
            )
    return sum(areas.values())


def _directed_curve(drawing: Drawing, name: str) -> np.ndarray:
    """Return a piece's curve in its direction, without the last point, which is the next curve's first."""
    points = drawing.curves[name.removeprefix("-")].points
    return points[::-1][:-1] if name[0] == "-" else points[:-1]


def _area(outline: np.ndarray) -> float:
    x, y = outline.T
    return float(0.5 * (x @ np.roll(y, -1) - y @ np.roll(x, -1)))


def _weld(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distinct points, and the number of each given point among them."""
    _, first, index = np.unique(_key(points), axis=0, return_index=True, return_inverse=True)
    return points[first], index.ravel()


def _find(points: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Return the numbers of the wanted points among ``points``."""
    where = {tuple(row): i for i, row in enumerate(_key(points).tolist())}
    return np.array([where[tuple(row)] for row in _key(wanted).tolist()])


def _key(points: np.ndarray) -> np.ndarray:
    """Return coordinates in micrometres, which no two points of a mesh share."""
    return np.round(points * 1e6).astype(np.int64)
