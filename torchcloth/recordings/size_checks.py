"""Checks of the cloth's size against the size of what was observed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from ..errors import RecordingError
from ..meshes import topology
from .types import ClothInfo, Recording

MAX_SPREAD_RATIO = 0.65  # median distance of the points from their median, over the cloth's length
MIN_SPREAD_RATIO = 0.03  # likewise
UNIT_MATCH_FACTOR = 1.5  # factor within which a unit is recognised
LENGTH_UNITS_M = {"millimetres": 1e-3, "centimetres": 1e-2, "inches": 0.0254, "feet": 0.3048}
MAX_SAMPLED_POINTS = 400  # of a frame
MIN_SIZED_CLOUD_POINTS = 10  # a frame of fewer points, such as single markers, shows no size


def cloud_diameter(cloud: np.ndarray) -> float:
    """Return the largest width [m] of a cloud over many directions: its diameter to 2 %."""
    if len(cloud) == 0:
        return 0.0
    turn, height = np.meshgrid(np.arange(24) * np.pi / 12, np.linspace(0, 1, 8))
    flat = np.sqrt(1 - height**2)
    directions = np.stack([flat * np.cos(turn), flat * np.sin(turn), height], -1).reshape(-1, 3)
    return float(np.ptp(cloud @ directions.T, axis=0).max())


def cloth_size(cloth: ClothInfo) -> tuple[float | None, float | None]:
    """Return the longest distance on the cloth [m] and its area [m^2]; None if the episode gives no shape."""
    if cloth.vertices is not None and cloth.faces is not None:
        a, b, c = (cloth.vertices[cloth.faces[:, k]] for k in range(3))
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
        lying = float(np.linalg.norm(np.ptp(cloth.vertices, axis=0)))
        return max(lying, _longest_panel_diagonal(cloth.faces, cloth.uv)), float(area)
    if cloth.sheet is not None:
        return float(np.hypot(*cloth.sheet)), float(np.prod(cloth.sheet))
    return None, None


def _longest_panel_diagonal(faces: np.ndarray, uv: np.ndarray | None) -> float:
    """Longest diagonal [m] of a panel in the pattern: a mesh that lies folded is shorter than its cloth."""
    if uv is None:
        return 0.0
    corners = uv[faces] if uv.ndim == 2 else uv
    panel = topology.number_panels(faces, corners)
    panels = (corners[panel == k].reshape(-1, 2) for k in np.unique(panel))
    return max(float(np.linalg.norm(np.ptp(panel_uv, axis=0))) for panel_uv in panels)


def sample_frames(recording: Recording) -> list[np.ndarray]:
    """Sample points [N, 3] m of every frame: of clouds, or else of markers."""
    rng = np.random.default_rng(0)
    return [
        c if len(c) <= MAX_SAMPLED_POINTS else c[rng.choice(len(c), MAX_SAMPLED_POINTS, replace=False)]
        for c in _frames(recording)
    ]


def detect_wrong_unit(clouds: Sequence[np.ndarray], length: float) -> tuple[str, str] | None:
    """Return what is wrong with clouds that no cloth of this length [m] could show, and the remedy.

    None means that nothing is wrong.
    """
    clouds = [c for c in clouds if len(c)]
    if not clouds:
        return None
    spreads = [float(np.median(np.linalg.norm(c - np.median(c, axis=0), axis=1))) for c in clouds]
    median_ratio, upper_ratio = (float(np.quantile(spreads, q)) / length for q in (0.5, 0.9))
    if upper_ratio >= MIN_SPREAD_RATIO and median_ratio <= MAX_SPREAD_RATIO:
        return None
    factor = float(np.median([cloud_diameter(c) for c in clouds])) / length
    unit = min(LENGTH_UNITS_M, key=lambda name: abs(np.log(factor * LENGTH_UNITS_M[name]))) if factor > 0 else ""
    guess = (
        f", as if in {unit}" if unit and abs(np.log(factor * LENGTH_UNITS_M[unit])) < np.log(UNIT_MATCH_FACTOR) else ""
    )
    return (
        f"the cloud is {factor:.3g} times as long as the cloth{guess}",
        "check the unit of points, of depth (depth_scale) and of the cloth's mesh, and leave out what is no cloth",
    )


def select_sized_clouds(clouds: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return the clouds with enough points to show a size."""
    return [c for c in clouds if len(c) >= MIN_SIZED_CLOUD_POINTS]


def detect_wrong_size(recording: Recording) -> tuple[str, str] | None:
    """Return the result of ``detect_wrong_unit`` for an episode, if its frames show enough."""
    length = cloth_size(recording.cloth)[0]
    return None if length is None else detect_wrong_unit(select_sized_clouds(sample_frames(recording)), length)


def check_size(recording: Recording) -> None:
    """Refuse observations in another unit than that of the cloth's description.

    Raises:
        RecordingError: clouds that no such cloth could show.
    """
    if (fault := detect_wrong_size(recording)) is not None:
        name = recording.path.name if recording.path else "recording"
        raise RecordingError(f"{name}: {fault[0]}", expected="points of the cloth, in metres", remedy=fault[1])


def _frames(recording: Recording) -> Iterator[np.ndarray]:
    points, markers = recording.points, recording.markers
    if points is not None:
        yield from np.split(points.xyz, np.cumsum(points.counts)[:-1])
    elif markers is not None:
        yield from (m[np.isfinite(m).all(-1)] for m in markers.xyz)
