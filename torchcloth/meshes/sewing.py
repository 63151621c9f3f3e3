"""From a flat drawing of half a garment to a sewn mesh: mirrored, doubled into front and back, welded along seams."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..errors import InvalidInput
from . import topology
from .mesh import Mesh
from .triangulation import distance_to_path, triangulate_outline, sample_polyline

PANEL_MARGIN_M = 0.05  # m between panels on the pattern
LIFT_RAMP_GAPS = 6.0  # gaps over which the layers part from a seam: the placement strains the cloth by 1 / (2 (2 RAMP)^2)
MAX_EDGE_LENGTH_TRIALS, TRIANGLE_COUNT_TOLERANCE = 8, 0.03  # at the wanted number of triangles

Kind = Literal[
    "sewn",  # front to back
    "joined",  # to the next panel of the same layer
    "fold",  # on the middle line, within one panel
    "open",  # a hem
]


@dataclass(frozen=True)
class Curve:
    """A line of the drawing: points [K, 2] m with x >= 0."""

    kind: Kind
    points: np.ndarray


@dataclass(frozen=True)
class Piece:
    """A panel of the drawing: its curves counter-clockwise ("-name": backwards) and the direction of its warp."""

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
    """Both halves of one layer."""

    points: np.ndarray  # [N, 2] m
    faces: np.ndarray  # [F, 3] counter-clockwise
    panel: np.ndarray  # [F]
    warp: np.ndarray  # [P, 2] unit, of each panel
    on: dict[tuple[str, str], np.ndarray]  # (side, curve) -> points in order


def sew(drawing: Drawing, triangles: int, gap: float) -> Mesh:
    """The mesh with about ``triangles`` triangles, its layers ``gap`` m apart.

    Raises:
        InvalidInput: measures or a number of triangles that give no sound mesh.
    """
    if not (gap >= 0 and np.isfinite(gap)):
        raise InvalidInput("gap", got=f"{gap:g} m", expected="a length >= 0")
    flat = _flatten(drawing, triangles)
    sewn = {name for name, curve in drawing.curves.items() if curve.kind == "sewn"}
    shared = np.zeros(len(flat.points), bool)
    for (_, name), index in flat.on.items():
        shared[index] |= name in sewn
    behind = np.where(shared, np.arange(len(shared)), len(shared) + np.cumsum(~shared) - 1)
    faces = np.vstack([flat.faces, behind[flat.faces][:, ::-1]])
    if (topology.find_edges(faces)[1] > 2).any():
        raise InvalidInput("triangles", got=triangles, expected="more, for these measures: a part is one triangle wide")
    lift = _lift(flat, sewn, gap)
    front = np.column_stack([flat.points, lift])
    vertices = np.vstack([front, (front * [1.0, 1.0, -1.0])[~shared]])
    vertices[:, :2] -= (vertices[:, :2].min(0) + vertices[:, :2].max(0)) / 2
    return Mesh.build(vertices, faces, _pattern(flat), _places(drawing, flat, behind)).renumber_along_longest_side()


def _flatten(drawing: Drawing, triangles: int) -> _Flat:
    """The layer whose double has the wanted number of triangles: the edge length is sought."""
    if triangles < 1:
        raise InvalidInput("triangles", got=triangles, expected="a positive number")
    area = _check_drawing(drawing)
    edge, found = (4 * area / triangles / (0.75**0.5 / 2)) ** 0.5, []
    for _ in range(MAX_EDGE_LENGTH_TRIALS):
        found.append(_half(drawing, edge))
        count = 4 * len(found[-1].faces)
        if abs(count / triangles - 1) < TRIANGLE_COUNT_TOLERANCE:
            break
        edge *= (count / triangles) ** 0.5
    return _mirrored(drawing, min(found, key=lambda half: abs(4 * len(half.faces) - triangles)))


def _half(drawing: Drawing, edge: float) -> _Flat:
    """The drawing's own half, its pieces joined."""
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
    on = {("right", name): _find(points, samples[name]) for name in samples}
    warp = np.array([piece.warp for piece in drawing.pieces.values()])
    warp /= np.linalg.norm(warp, axis=1, keepdims=True)
    return _Flat(points, index[np.vstack(faces)], np.array(panel), warp, on)


def _mirrored(drawing: Drawing, half: _Flat) -> _Flat:
    """Both halves, welded on the middle line; a piece with a fold is one panel, others become two."""
    flip = np.array([-1.0, 1.0])
    points, index = _weld(np.vstack([half.points, half.points * flip]))
    here, there = np.split(index, 2)
    folded = [
        any(drawing.curves[c.removeprefix("-")].kind == "fold" for c in p.curves) for p in drawing.pieces.values()
    ]
    other = np.where(np.array(folded)[half.panel], half.panel, half.panel + len(folded))
    on = {("right", name): here[i] for (_, name), i in half.on.items()}
    on |= {("left", name): there[i] for (_, name), i in half.on.items()}
    return _Flat(
        points,
        np.vstack([here[half.faces], there[half.faces][:, ::-1]]),
        np.concatenate([half.panel, other]),
        np.vstack([half.warp, half.warp * flip]),
        on,
    )


def _pattern(flat: _Flat) -> np.ndarray:
    """[2 F, 3, 2] m, the panels beside each other as they are cut, all with their outer side up, warp along u."""
    layers, start = [], 0.0
    for side, order in ((1.0, [0, 1, 2]), (-1.0, [2, 1, 0])):
        layer = np.zeros((len(flat.faces), 3, 2))
        for panel, warp in enumerate(flat.warp):
            own = flat.panel == panel
            if own.any():
                laid = flat.points @ np.stack([warp, side * np.array([-warp[1], warp[0]])], axis=1)
                laid = laid[flat.faces[own][:, order]]
                layer[own] = laid - laid.min((0, 1)) + [0.0, start]
                start = layer[own][..., 1].max() + PANEL_MARGIN_M
        layers.append(layer)
    return np.concatenate(layers)


def _lift(flat: _Flat, sewn: set[str], gap: float) -> np.ndarray:
    """[N] m, height of the front layer: 0 at seams, half the gap away from them."""
    if gap == 0:
        return np.zeros(len(flat.points))
    seams = [flat.points[index] for (_, name), index in flat.on.items() if name in sewn]
    distance = np.min([distance_to_path(flat.points, seam) for seam in seams], axis=0)
    return gap / 2 * np.minimum(1.0, distance / (LIFT_RAMP_GAPS * gap))


def _places(drawing: Drawing, flat: _Flat, behind: np.ndarray) -> dict[str, np.ndarray]:
    """Corners, openings and seams by name; those that meet their mirror image are one, also named by layer."""
    out = {}
    for name, (curve, end) in drawing.corners.items():
        out |= {f"{side} {name}": flat.on[side, curve][[end]] for side in ("left", "right")}
    for curve, drawn in drawing.curves.items():
        name = curve if drawn.kind == "open" else f"{curve} seam"
        left, right = flat.on["left", curve], flat.on["right", curve]
        if drawn.kind == "fold":
            continue
        if drawn.kind != "sewn" and len(np.intersect1d(left, right)):
            both = np.union1d(left, right)
            out |= {name: np.union1d(both, behind[both])}
            out |= {f"{name} front": both, f"{name} back": np.unique(behind[both])}
        else:
            out |= {f"left {name}": np.union1d(left, behind[left]), f"right {name}": np.union1d(right, behind[right])}
    return out


def _check_drawing(drawing: Drawing) -> float:
    """Area [m^2] of the drawing; refuses pieces that turn over, cross the middle or lie on each other."""
    from matplotlib.path import Path

    outlines = {
        name: np.vstack([_directed(drawing, c) for c in piece.curves]) for name, piece in drawing.pieces.items()
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


def _directed(drawing: Drawing, name: str) -> np.ndarray:
    """A piece's curve in its direction, without the last point, which is the next one's first."""
    points = drawing.curves[name.removeprefix("-")].points
    return points[::-1][:-1] if name[0] == "-" else points[:-1]


def _area(outline: np.ndarray) -> float:
    x, y = outline.T
    return float(0.5 * (x @ np.roll(y, -1) - y @ np.roll(x, -1)))


def _weld(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(distinct points, the number of each given one among them)."""
    _, first, index = np.unique(_key(points), axis=0, return_index=True, return_inverse=True)
    return points[first], index.ravel()


def _find(points: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Numbers of the points that are the wanted ones."""
    where = {tuple(row): i for i, row in enumerate(_key(points).tolist())}
    return np.array([where[tuple(row)] for row in _key(wanted).tolist()])


def _key(points: np.ndarray) -> np.ndarray:
    """Micrometres, which no two points of a mesh share."""
    return np.round(points * 1e6).astype(np.int64)
