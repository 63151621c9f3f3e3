"""Reading and writing of Wavefront OBJ, as far as a rest mesh needs it: v, vt and f."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from ..errors import InvalidInput

MAX_FINITE_COORDINATE = 1e100  # larger values count as infinite; squares of smaller ones stay finite
VALUES_PER_LINE_KIND = {"v": 3, "vt": 2}  # more may follow on a line


def parse(text: str, place: str) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Read vertices [V, 3], faces [F, 3] (polygons are fanned) and vt of their corners [F, 3, 2], or None without.

    Args:
        text: the file's text.
        place: its name, for messages.

    Raises:
        InvalidInput: a damaged line, numbers that are not finite, no faces, a vertex in no face.
    """
    v, vt, corners = [], [], []
    polygons: dict[int, list[int]] = {}  # vertices of faces with more than three corners, by line
    for number, line in enumerate(text.splitlines(), 1):
        word, *items = line.split("#")[0].split() or [""]
        try:
            if word in ("v", "vt") and len(items) < VALUES_PER_LINE_KIND[word]:
                raise ValueError(f"{len(items)} numbers")
            if word == "v":
                v.append([float(x) for x in items[: VALUES_PER_LINE_KIND[word]]])
            elif word == "vt":
                vt.append([float(x) for x in items[: VALUES_PER_LINE_KIND[word]]])
            elif word == "f":
                ring = [_corner(item, len(v), len(vt)) for item in items]
                if len(ring) < 3:
                    raise ValueError(f"{len(ring)} corners")
                if len(ring) > 3:
                    polygons[number] = [i for i, _ in ring]
                corners += [(ring[0], *pair) for pair in pairwise(ring[1:])]
        except ValueError as error:
            raise InvalidInput(
                f"{place} is damaged at line {number}",
                got=repr(line[:60]),
                expected="v X Y Z, vt U V, or f with numbers of three vertices or more",
            ) from error
    vertices = _rows(v, f"{place}: v", 3)
    for number, ring in polygons.items():
        check_convex(vertices[ring][None], f"{place}, line {number}")
    index = _rows(corners, f"{place}: f", 3, 2).astype(np.int64)
    faces, patches = index[..., 0], index[..., 1]
    unused = np.setdiff1d(np.arange(len(vertices)), faces)
    if unused.size:
        raise InvalidInput(
            f"{place} has a vertex in no face", got=f"vertex {unused[0] + 1}", remedy="remove loose vertices"
        )
    if (patches < 0).any():
        if (patches >= 0).any():
            got = f"{int((patches < 0).any(1).sum())} of {len(faces)} triangles without"
            remedy = "give it everywhere, or nowhere"
            raise InvalidInput(f"{place}: vt", got=got, expected="pattern coordinates of all corners", remedy=remedy)
        return vertices, faces, None
    return vertices, faces, _rows(vt, f"{place}: vt", 2)[patches]


def check_convex(polygons: np.ndarray, place: str) -> None:
    """Check that a fan of triangles covers each of the polygons [N, K, 3] once.

    Raises:
        InvalidInput: one is not convex, or folded onto itself, or has coordinates that are not finite.
    """
    if not (np.abs(polygons) < MAX_FINITE_COORDINATE).all():
        raise InvalidInput(f"{place} is not finite", expected="numbers", remedy="drop or repair that polygon")
    edges = polygons[:, 1:] - polygons[:, :1].astype(float)
    size = np.abs(edges).max(axis=(1, 2), keepdims=True)
    edges = edges / np.maximum(size, np.finfo(float).tiny)  # the fourth powers of lengths below could overflow
    twice = np.cross(edges[:, :-1], edges[:, 1:])
    bent = (twice * twice.sum(1, keepdims=True)).sum(-1) < -1e-9 * (twice**2).sum((-2, -1))[:, None]
    if (bent := bent.any(1)).any():
        got = f"polygon {int(np.flatnonzero(bent)[0]) + 1} of {len(polygons)}"
        raise InvalidInput(f"{place}: a polygon is not convex", got=got, remedy="triangulate on export")


def dump(vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray | None) -> str:
    """Format a mesh as OBJ text, with pattern coordinates [V, 2], [F, 3, 2] or None; numbers read back exactly."""
    rows, corner, uv = np.zeros((0, 2)), np.asarray(faces), None if uv is None else np.asarray(uv)
    if uv is not None and uv.ndim == 2:
        rows = uv
    elif uv is not None:
        rows, corner = np.unique(uv.reshape(-1, 2), axis=0, return_inverse=True)
        corner = corner.reshape(-1, 3)
    lines = [f"v {' '.join(map(repr, row))}" for row in np.asarray(vertices).tolist()]
    lines += [f"vt {' '.join(map(repr, row))}" for row in rows.tolist()]
    form = "{0}" if uv is None else "{0}/{1}"
    pairs = np.stack([faces, corner], axis=-1) + 1
    lines += ["f " + " ".join(form.format(*pair) for pair in face) for face in pairs.tolist()]
    return "\n".join(lines) + "\n"


def _corner(item: str, vertices: int, coordinates: int) -> tuple[int, int]:
    """Return zero-based vertex and vt index (-1 without) of "v", "v/vt" or "v/vt/vn"; negatives count from the end."""
    first, second, *_ = [*item.split("/"), ""]
    i = int(first) - 1 if int(first) > 0 else vertices + int(first)
    k = -1 if not second else int(second) - 1 if int(second) > 0 else coordinates + int(second)
    if not 0 <= i < vertices or not (0 if second else -1) <= k < coordinates:
        raise ValueError(f"index out of range: {item}")
    return i, k


def _rows(rows: list, place: str, *shape: int) -> np.ndarray:
    """Return finite numbers [N, *shape]."""
    try:
        data = np.array(rows, dtype=np.float64)
    except (ValueError, OverflowError):
        raise InvalidInput(f"{place} is not a rectangular array", expected=f"{shape} numbers each") from None
    if data.shape[1:] != shape:
        expected = f"[{', '.join(map(str, ('N', *shape)))}]"
        raise InvalidInput(f"{place} has the wrong shape", got=list(data.shape), expected=expected)
    if not (np.abs(data) < MAX_FINITE_COORDINATE).all():
        raise InvalidInput(f"{place} is not finite", expected="numbers", remedy="drop or repair that line")
    return data
