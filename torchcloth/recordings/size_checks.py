"""How large a cloth is, and how large what was seen of it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from ..errors import RecordingError
from ..meshes import topology
from .types import ClothInfo, Recording

TOO_WIDE, TOO_NARROW = 0.65, 0.03  # of the cloth's length: half of the points lie within so much of their middle
SURELY = 1.5  # factor within which a unit is recognised
LENGTHS = {"millimetres": 1e-3, "centimetres": 1e-2, "inches": 0.0254, "feet": 0.3048}
SOME = 400  # points of a frame that are looked at
ENOUGH = 10  # points in a frame; fewer, as single markers, show no size


def longest(cloud: np.ndarray) -> float:
    """Largest width of a cloud, m, over many directions: its diameter to 2 %."""
    if len(cloud) == 0:
        return 0.0
    turn, height = np.meshgrid(np.arange(24) * np.pi / 12, np.linspace(0, 1, 8))
    flat = np.sqrt(1 - height**2)
    directions = np.stack([flat * np.cos(turn), flat * np.sin(turn), height], -1).reshape(-1, 3)
    return float(np.ptp(cloud @ directions.T, axis=0).max())


def size(cloth: ClothInfo) -> tuple[float | None, float | None]:
    """Longest distance on the cloth, m, and its area, m^2."""
    if cloth.vertices is not None and cloth.faces is not None:
        a, b, c = (cloth.vertices[cloth.faces[:, k]] for k in range(3))
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
        lying = float(np.linalg.norm(np.ptp(cloth.vertices, axis=0)))
        return max(lying, _cut(cloth.faces, cloth.uv)), float(area)
    if cloth.sheet is not None:
        return float(np.hypot(*cloth.sheet)), float(np.prod(cloth.sheet))
    return None, None


def _cut(faces: np.ndarray, uv: np.ndarray | None) -> float:
    """Longest diagonal of a panel in the pattern, m: where the mesh lies folded, the cloth is longer than it lies."""
    if uv is None:
        return 0.0
    corners = uv[faces] if uv.ndim == 2 else uv
    panel = topology.panels(faces, corners)
    each = (corners[panel == k].reshape(-1, 2) for k in np.unique(panel))
    return max(float(np.linalg.norm(np.ptp(own, axis=0))) for own in each)


def seen(recording: Recording) -> list[np.ndarray]:
    """Some points [N, 3] m of every frame: of clouds, or else of markers."""
    rng = np.random.default_rng(0)
    return [c if len(c) <= SOME else c[rng.choice(len(c), SOME, replace=False)] for c in _frames(recording)]


def other_unit(clouds: Sequence[np.ndarray], length: float) -> tuple[str, str] | None:
    """What is wrong with clouds that no cloth of this length [m] could show, and the remedy; None where nothing is."""
    clouds = [c for c in clouds if len(c)]
    if not clouds:
        return None
    spreads = [float(np.median(np.linalg.norm(c - np.median(c, axis=0), axis=1))) for c in clouds]
    wide, narrow = (float(np.quantile(spreads, q)) / length for q in (0.5, 0.9))
    if narrow >= TOO_NARROW and wide <= TOO_WIDE:
        return None
    factor = float(np.median([longest(c) for c in clouds])) / length
    unit = min(LENGTHS, key=lambda name: abs(np.log(factor * LENGTHS[name]))) if factor > 0 else ""
    guess = f", as if in {unit}" if unit and abs(np.log(factor * LENGTHS[unit])) < np.log(SURELY) else ""
    return (
        f"the cloud is {factor:.3g} times as long as the cloth{guess}",
        "check the unit of points, of depth (depth_scale) and of the cloth's mesh, and leave out what is no cloth",
    )


def full(clouds: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Those that show a size."""
    return [c for c in clouds if len(c) >= ENOUGH]


def of_another_size(recording: Recording) -> tuple[str, str] | None:
    """The same for an episode, where its frames show enough to tell."""
    length = size(recording.cloth)[0]
    return None if length is None else other_unit(full(seen(recording)), length)


def check_size(recording: Recording) -> None:
    """Refuse what was seen in another unit than the cloth is described in.

    Raises:
        RecordingError: clouds that no such cloth could show.
    """
    if (found := of_another_size(recording)) is not None:
        name = recording.path.name if recording.path else "recording"
        raise RecordingError(f"{name}: {found[0]}", expected="points of the cloth, in metres", remedy=found[1])


def _frames(recording: Recording) -> Iterator[np.ndarray]:
    points, markers = recording.points, recording.markers
    if points is not None:
        yield from np.split(points.xyz, np.cumsum(points.counts)[:-1])
    elif markers is not None:
        yield from (m[np.isfinite(m).all(-1)] for m in markers.xyz)
