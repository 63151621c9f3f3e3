"""The little of Wavefront OBJ that a rest mesh needs: v, vt and f."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from ..errors import RecordingError
from . import checks


def parse(text: str, place: str) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Return vertices [V, 3], faces [F, 3] (polygons are fanned) and per-vertex uv [V, 2], or None without vt."""
    v, vt, corners = [], [], []
    for number, line in enumerate(text.splitlines(), 1):
        word, *items = line.split("#")[0].split() or [""]
        try:
            if word == "v":
                v.append([float(x) for x in items[:3]])
            elif word == "vt":
                vt.append([float(x) for x in items[:2]])
            elif word == "f":
                ring = [_corner(item, len(v), len(vt)) for item in items]
                corners += [(ring[0], *pair) for pair in pairwise(ring[1:])]
        except ValueError as error:
            raise RecordingError(
                f"{place} is damaged at line {number}", got=repr(line[:60]), expected="v, vt or f"
            ) from error
    vertices = checks.array(v, f"{place}: v", ("V", 3))
    index = checks.array(corners, f"{place}: f", ("F", 3, 2), "int")
    faces, patches = index[..., 0], index[..., 1]
    unused = np.setdiff1d(np.arange(len(vertices)), faces)
    if unused.size:
        raise RecordingError(
            f"{place} has a vertex in no face", got=f"vertex {unused[0] + 1}", remedy="remove loose vertices"
        )
    if not vt or (patches < 0).any():
        return vertices, faces, None
    corner_uv = checks.array(vt, f"{place}: vt", ("N", 2))[patches]
    return vertices, faces, _per_vertex(len(vertices), faces, corner_uv, place)


def dump(vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray | None) -> str:
    """The OBJ text; numbers are written so that they read back exactly."""
    rows = [("v", row) for row in vertices.tolist()] + [("vt", row) for row in ([] if uv is None else uv.tolist())]
    lines = [f"{word} {' '.join(map(repr, row))}" for word, row in rows]
    corner = "{0}" if uv is None else "{0}/{0}"
    lines += ["f " + " ".join(corner.format(i + 1) for i in face) for face in faces.tolist()]
    return "\n".join(lines) + "\n"


def _corner(item: str, vertices: int, coordinates: int) -> tuple[int, int]:
    """Zero-based vertex and vt index of "v", "v/vt" or "v/vt/vn" (-1 without vt); negative ones count from the end."""
    first, second, *_ = [*item.split("/"), ""]
    i = int(first) - 1 if int(first) > 0 else vertices + int(first)
    k = -1 if not second else int(second) - 1 if int(second) > 0 else coordinates + int(second)
    if not 0 <= i < vertices or not -1 <= k < coordinates:
        raise ValueError(f"index out of range: {item}")
    return i, k


def _per_vertex(count: int, faces: np.ndarray, corner_uv: np.ndarray, place: str) -> np.ndarray:
    uv = np.zeros((count, 2))
    uv[faces] = corner_uv
    if not np.array_equal(uv[faces], corner_uv):
        vertex = int(faces[(uv[faces] != corner_uv).any(axis=-1)][0]) + 1
        expected = "one vt per vertex"
        raise RecordingError(
            f"{place} has a seam", got=f"two vt at vertex {vertex}", expected=expected, remedy="split the vertex"
        )
    return uv
