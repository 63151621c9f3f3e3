"""What episodes of one fit or diagnosis share: one cloth, held at the same places, in one scene."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from os import PathLike
from typing import Any
from zlib import crc32

import numpy as np

from ..errors import InvalidInput
from .fingerprints import positions
from .scene import FRICTION, THICKNESS
from .types import Collider, GraspInfo, Recording

INSIDE = 0.02  # m, that noise and a table's place may explain
ALIKE, UPRIGHT = 0.005, 0.9999  # m, and cosine (0.8 degrees): a table that was measured twice


def check_recording(value: object) -> None:
    """Raises InvalidInput for what is no recording, such as its path."""
    if not isinstance(value, Recording):
        got = repr(str(value)) if isinstance(value, str | PathLike) else type(value).__name__
        remedy = "read it: torchcloth.recordings.read(path)"
        raise InvalidInput("recording", got=got, expected="a Recording", remedy=remedy)


def listed(recordings: Recording | Sequence[Recording]) -> list[Recording]:
    """One or several.

    Raises:
        InvalidInput: something among them is no recording.
    """
    given: Any = recordings
    found: list[Any] = list(given) if isinstance(given, Iterable) and not isinstance(given, str) else [given]
    for recording in found:
        check_recording(recording)
    return found


def name_of(recording: Recording, k: int) -> str:
    """Of the k-th episode, in messages."""
    return recording.path.name if recording.path is not None else f"episode {k}"


def same_cloth(recordings: Sequence[Recording], anywhere: bool = False) -> None:
    """Raises InvalidInput where the episodes do not describe one cloth, held at the same places.

    With ``anywhere`` the mesh, gravity and places of grasps may differ, but not which there are.
    """
    first = recordings[0]
    for k, other in enumerate(recordings[1:], 1):
        for what, of in (_CLOTH if anywhere else _CLOTH | _SCENE).items():
            a, b = of(first), of(other)
            if not _equal(a, b):
                raise InvalidInput(
                    f"{name_of(other, k)}: another {what} than in {name_of(first, 0)}",
                    got=_shown(b),
                    expected=_shown(a),
                    remedy="take the episodes of each cloth apart, or correct the description of one",
                )


_CLOTH = {
    "cloth (width and height of the pattern, m)": lambda r: (
        None if (b := r.cloth.pattern_box()) is None else b[1] - b[0]
    ),
    "areal density (kg/m^2)": lambda r: r.cloth.areal_density,
    "thickness (m)": lambda r: THICKNESS if r.cloth.thickness is None else r.cloth.thickness,
    "data sheet": lambda r: {name: value for name, value in sorted(r.cloth.nominal.items()) if name != "units"},
    "set of grasps": lambda r: sorted(r.grasps),
}
_SCENE = {
    "mesh (vertices, triangles)": lambda r: (
        None if r.cloth.faces is None else [int(r.cloth.faces.max()) + 1, len(r.cloth.faces)]
    ),
    "numbering of the mesh (checksum of its triangles)": lambda r: (
        None if r.cloth.faces is None else f"{crc32(r.cloth.faces.astype('<i8').tobytes()):08x}"
    ),
    "gravity (m/s^2)": lambda r: r.gravity,
    "vertices of a grasp": lambda r: [np.sort(g.vertices).tolist() for g in _grasps(r) if g.vertices is not None],
    "radius of a grasp (m)": lambda r: [g.radius for g in _grasps(r) if g.uv is not None],
    "air (whether its density is known)": lambda r: r.air_density is not None,
    "place of a grasp (m)": lambda r: [g.uv.tolist() for g in _grasps(r) if g.uv is not None],
}


def _grasps(recording: Recording) -> list[GraspInfo]:
    return [recording.grasps[name] for name in sorted(recording.grasps)]


def _equal(a: object, b: object) -> bool:
    if a is None or b is None:
        return a is b
    try:
        one, two = np.asarray(a), np.asarray(b)
    except ValueError:  # of several lengths
        return a == b
    if one.dtype.kind != "f" or two.dtype.kind != "f":  # indices, counts, names
        return np.array_equal(one, two)
    return one.shape == two.shape and bool(np.allclose(one, two, rtol=1e-3, atol=1e-6))


def _shown(value: object) -> str:
    if value is None:
        return "none"
    if isinstance(value, float):
        return f"{value:.6g}"
    return " x ".join(f"{x:.4g}" for x in value) if isinstance(value, np.ndarray) else str(value)


def together(recordings: Sequence[Recording]) -> Recording:
    """The first episode with the tables of all: an episode may lack one that its cloth never comes near.

    Raises:
        InvalidInput: a table that stands elsewhere in another episode, or in which another's cloth was seen.
    """
    tables: dict[str, Collider] = {}
    for name, table in (named for r in recordings for named in r.colliders.items()):
        if not _same(first := tables.setdefault(name, table), table):
            raise InvalidInput(
                f"table {name!r}",
                got=f"{_described(first)} in one episode, {_described(table)} in another",
                expected="one scene",
                remedy="take the episodes of each scene apart, or name what differs apart",
            )
    for r in recordings:
        for name, table in tables.items():
            depths = [0.0] if name in r.colliders else [_depth(xyz, table) for xyz in positions(r) if len(xyz)]
            if (depth := max(depths, default=0.0)) > INSIDE:
                raise InvalidInput(
                    "episodes",
                    got=f"cloth {depth:.3f} m inside {name!r}, which only other episodes have",
                    expected="one scene",
                    remedy="take episodes with and without it apart, or name it in every episode.json",
                )
    return replace(recordings[0], colliders=tables)


def _same(a: Collider, b: Collider) -> bool:
    """One plane, up to how well a table is measured, of one friction."""
    away = abs(float((b.point - a.point) @ a.normal))
    return away < ALIKE and float(a.normal @ b.normal) > UPRIGHT and _friction(a) == _friction(b)


def _friction(table: Collider) -> float:
    return FRICTION if table.friction is None else table.friction


def _described(table: Collider) -> str:
    point, normal = (" ".join(f"{x:.3g}" for x in v) for v in (table.point, table.normal))
    return f"({point}) m, normal ({normal}), friction {table.friction}"


def _depth(points: np.ndarray, table: Collider) -> float:
    """m, by which the deepest hundredth of the points lies inside."""
    return -float(np.quantile((points - table.point) @ table.normal, 0.01))
