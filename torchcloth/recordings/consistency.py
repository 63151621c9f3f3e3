"""Consistency of the episodes of one fit or diagnosis: one cloth, held at the same places, in one scene."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from os import PathLike
from typing import Any
from zlib import crc32

import numpy as np

from ..errors import InvalidInput
from .fingerprints import observed_positions
from .scene import DEFAULT_TABLE_FRICTION, DEFAULT_THICKNESS_M
from .types import Collider, GraspInfo, Recording

MAX_PENETRATION_M = 0.02  # of cloth into a table, which noise and the table's calibration may explain
MAX_PLANE_OFFSET_M = 0.005  # between two measurements of one table
MIN_PLANE_NORMAL_COSINE = 0.9999  # of the angle between two measurements of one table, 0.8 degrees
PENETRATION_QUANTILE = 0.01  # of the points' heights above a table
RELATIVE_TOLERANCE = 1e-3  # of two values of one quantity


def check_recording(value: object) -> None:
    """Refuse a value that is no recording, such as its path.

    Raises:
        InvalidInput: it is none.
    """
    if not isinstance(value, Recording):
        got = repr(str(value)) if isinstance(value, str | PathLike) else type(value).__name__
        remedy = "read it: torchcloth.recordings.read(path)"
        raise InvalidInput("recording", got=got, expected="a Recording", remedy=remedy)


def as_list(recordings: Recording | Sequence[Recording]) -> list[Recording]:
    """Return one or several recordings as a list.

    Raises:
        InvalidInput: something among them is no recording.
    """
    given: Any = recordings
    items: list[Any] = list(given) if isinstance(given, Iterable) and not isinstance(given, str) else [given]
    for recording in items:
        check_recording(recording)
    return items


def display_name(recording: Recording, k: int) -> str:
    """Return the name of the k-th episode for messages."""
    return recording.path.name if recording.path is not None else f"episode {k}"


def check_same_cloth(recordings: Sequence[Recording], any_scene: bool = False) -> None:
    """Refuse episodes that do not describe one cloth, held at the same places.

    Args:
        recordings: the episodes.
        any_scene: the mesh, gravity and the places of grasps may differ, but not the set of grasps.

    Raises:
        InvalidInput: names the first difference.
    """
    first = recordings[0]
    for k, other in enumerate(recordings[1:], 1):
        for what, get in (_CLOTH_FACTS if any_scene else _CLOTH_FACTS | _SCENE_FACTS).items():
            a, b = get(first), get(other)
            if not _equal(a, b):
                raise InvalidInput(
                    f"{display_name(other, k)}: another {what} than in {display_name(first, 0)}",
                    got=_format(b),
                    expected=_format(a),
                    remedy="use the episodes of each cloth separately, or correct the description of one",
                )


_CLOTH_FACTS = {
    "cloth (width and height of the pattern, m)": lambda r: (
        None if (b := r.cloth.pattern_box()) is None else b[1] - b[0]
    ),
    "areal density (kg/m^2)": lambda r: r.cloth.areal_density,
    "thickness (m)": lambda r: DEFAULT_THICKNESS_M if r.cloth.thickness is None else r.cloth.thickness,
    "layer gap (m)": lambda r: r.cloth.layer_gap,
    "data sheet": lambda r: {name: value for name, value in sorted(r.cloth.nominal.items()) if name != "units"},
    "set of grasps": lambda r: sorted(r.grasps),
}
_SCENE_FACTS = {
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
    return one.shape == two.shape and bool(np.allclose(one, two, rtol=RELATIVE_TOLERANCE, atol=1e-6))


def _format(value: object) -> str:
    if value is None:
        return "none"
    if isinstance(value, float):
        return f"{value:.6g}"
    return " x ".join(f"{x:.4g}" for x in value) if isinstance(value, np.ndarray) else str(value)


def merge_scene(recordings: Sequence[Recording]) -> Recording:
    """Return the first episode with the tables of all: an episode may lack a table that its cloth never comes near.

    Raises:
        InvalidInput: a table has another pose in another episode, or another episode's cloth is inside it.
    """
    tables: dict[str, Collider] = {}
    for name, table in (named for r in recordings for named in r.colliders.items()):
        if not _is_same_table(first := tables.setdefault(name, table), table):
            raise InvalidInput(
                f"table {name!r}",
                got=f"{_describe_table(first)} in one episode, {_describe_table(table)} in another",
                expected="one scene",
                remedy="use the episodes of each scene separately, or give different things different names",
            )
    for r in recordings:
        for name, table in tables.items():
            depths = (
                [0.0]
                if name in r.colliders
                else [_penetration(xyz, table) for xyz in observed_positions(r) if len(xyz)]
            )
            if (depth := max(depths, default=0.0)) > MAX_PENETRATION_M:
                raise InvalidInput(
                    "episodes",
                    got=f"cloth {depth:.3f} m inside {name!r}, which only other episodes have",
                    expected="one scene",
                    remedy="take episodes with and without it apart, or name it in every episode.json",
                )
    return replace(recordings[0], colliders=tables)


def _is_same_table(a: Collider, b: Collider) -> bool:
    """One plane, up to measurement errors, with one friction."""
    away = abs(float((b.point - a.point) @ a.normal))
    return (
        away < MAX_PLANE_OFFSET_M
        and float(a.normal @ b.normal) > MIN_PLANE_NORMAL_COSINE
        and _friction(a) == _friction(b)
    )


def _friction(table: Collider) -> float:
    return DEFAULT_TABLE_FRICTION if table.friction is None else table.friction


def _describe_table(table: Collider) -> str:
    point, normal = (" ".join(f"{x:.3g}" for x in v) for v in (table.point, table.normal))
    return f"({point}) m, normal ({normal}), friction {table.friction}"


def _penetration(points: np.ndarray, table: Collider) -> float:
    """Depth [m] of the deepest hundredth of the points inside."""
    return -float(np.quantile((points - table.point) @ table.normal, PENETRATION_QUANTILE))
