"""Which frames cannot be the cloth, how much of it each shows, and what is cut off or stray."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import MissingDependency, RecordingError
from ..observe import Segmentation, segment
from ..recordings import ClothInfo, Markers, PointClouds
from ..recordings.size_checks import longest, size
from .crop_planes import cuts
from .nan_statistics import median

TOLERANCE = 0.1  # of the cloth's size
NEIGHBOURS = 4  # of a marker, whose pattern distances are looked at
AREA = 8  # neighbours that say how much area a point stands for
LINK = 3.0  # times the usual distance of neighbours, within which points belong together
QUERIES, LARGE = 300, 20_000  # points looked at closely, and among so many


@dataclass(frozen=True, eq=False)
class Frames:
    """Frame by frame.

    Attributes:
        rejected: [T] bool, that cannot be the cloth.
        why: how they were told.
        coverage: [T] share of the markers seen; of clouds, area seen over the cloth's (NaN where that is unknown).
        removed: of clouds, how many points of all frames each stage of a `Segmentation` takes.
        cuts: of clouds, bounds at which they end whatever the cloth does: {"z >": 0.075}.
    """

    rejected: np.ndarray
    why: str
    coverage: np.ndarray
    removed: dict[str, int]
    cuts: dict[str, float]


def of_markers(markers: Markers, cloth: ClothInfo) -> Frames:
    """Frames of markers: their distances must be those of the cloth to 10 %.

    With ``uv``: median ratio of the distances of neighbours to those in the pattern. Else of a grid (``extra["grid"]``,
    [rows, columns] of the markers in order) on a sheet: median arc along its rows and along its columns against the
    sheet's sides. With neither: distances to their own usual ones. A cloth that is folded between most of its markers
    looks too short.
    """
    seen = np.isfinite(markers.xyz[..., 0])
    if markers.uv is None and "grid" in markers.extra and cloth.sheet is not None:
        ratio, why = _arcs(markers, cloth.sheet), "arcs along rows and columns against the sheet's sides"
    else:
        ratio, why = _neighbours(markers)
    with np.errstate(invalid="ignore"):
        rejected = np.logical_not(np.all(np.abs(ratio - 1) <= TOLERANCE, axis=-1))
    return Frames(rejected, why, seen.mean(1), {}, {})


def _arcs(markers: Markers, sheet: tuple[float, float]) -> np.ndarray:
    """[T, 2] median lengths of rows and columns, each over the side of the sheet that it usually is nearer to."""
    given = np.asarray(markers.extra["grid"])
    whole = given.shape == (2,) and given.dtype.kind in "iuf" and bool((given == np.round(given)).all())
    if not whole or given.min() < 2 or given.prod() != markers.xyz.shape[1]:
        raise RecordingError(
            "markers: grid does not fit",
            got=given.tolist(),
            expected=f"[rows, columns] of {markers.xyz.shape[1]} markers, two at least of each",
        )
    rows, columns = given.astype(int).tolist()
    grid = markers.xyz.reshape(len(markers.t), rows, columns, 3)
    arcs = np.stack([median(_arc(np.linalg.norm(np.diff(grid, axis=k), axis=-1), k), -1) for k in (1, 2)], -1)
    usual = median(arcs, 0)
    sides = np.array([sheet, sheet[::-1]])
    return arcs / sides[np.argmin(np.abs(sides - usual).sum(1))]


def _arc(pieces: np.ndarray, axis: int) -> np.ndarray:
    """Sums of lengths along an axis; up to half of them may be unseen, and count as the mean of the others."""
    seen = np.isfinite(pieces)
    enough = seen.mean(axis) >= 0.5
    mean = np.where(seen, pieces, 0.0).sum(axis) / np.maximum(seen.sum(axis), 1)
    return np.where(enough, mean * pieces.shape[axis], np.nan)


def _neighbours(markers: Markers) -> tuple[np.ndarray, str]:
    """[T, 1] median ratio of neighbours' distances to what they should be."""
    xyz = markers.xyz
    if markers.uv is not None:
        reference, why = markers.uv, "distances of neighbours against the pattern's"
    else:
        reference, why = median(xyz, 0), "distances of neighbours against their usual ones, size unknown"
    away = np.linalg.norm(reference[:, None] - reference, axis=-1)
    np.fill_diagonal(away, np.inf)
    count = min(NEIGHBOURS, len(away) - 1)
    if count < 1:
        return np.ones((len(xyz), 1)), "a single marker: nothing to compare"
    near = np.argsort(away, axis=1)[:, :count]
    distance = np.linalg.norm(xyz[:, near] - xyz[:, :, None], axis=-1).reshape(len(xyz), -1)
    pattern = markers.uv is not None
    expected = np.take_along_axis(away, near, axis=1).ravel() if pattern else median(distance, 0)
    with np.errstate(divide="ignore", invalid="ignore"):  # of markers in one place
        ratio = np.where(expected > 0, distance / expected, np.nan)
    return median(ratio, -1)[:, None], why


def of_clouds(clouds: PointClouds, cloth: ClothInfo, held: np.ndarray) -> tuple[Frames, list[str]]:
    """Frames of clouds: outliers aside, none may be wider than the cloth is long, to 10 %.

    Args:
        clouds: T frames.
        cloth: its size.
        held: [T, G, 3] m, where the grippers are in each frame; G may be 0.

    Returns:
        The frames, and notes on what could not be done.
    """
    kept, removed, notes = [], {}, []
    for i in range(len(clouds)):
        cloud = clouds.frame(i)
        try:
            found = segment(cloud, _stages(cloud))
        except MissingDependency as error:
            kept, removed, notes = [clouds.frame(k) for k in range(len(clouds))], {}, [f"outliers not counted: {error}"]
            break
        kept.append(found.points)
        removed = {stage: removed.get(stage, 0) + count for stage, count in found.removed.items()}
    length, area = size(cloth)
    extent = np.array([longest(c) for c in kept])
    seen = np.array([_area(c) for c in kept]) / (area or np.nan)
    why = "larger than the cloth" if length else "none: the cloth's size is unknown"
    rejected = np.greater(extent, (1 + TOLERANCE) * length if length else np.inf) | (extent == 0)
    found = cuts([clouds.frame(i) for i in range(len(clouds))], kept, cloth, seen, held)
    return Frames(rejected, why, seen, removed, found), notes


def _stages(cloud: np.ndarray) -> Segmentation:
    """Outliers and pieces apart, on the cloud's own scale."""
    return Segmentation(gap=max(0.01, LINK * _spacing(cloud)), crowd=4)


def _nearest(cloud: np.ndarray, count: int) -> np.ndarray:
    """[Q] m, distance of some points to their ``count``-th neighbour."""
    if len(cloud) <= count:
        return np.zeros(0)
    cloud = cloud - cloud.mean(0)  # squares of small numbers keep their digits
    some = cloud[np.unique(np.linspace(0, len(cloud) - 1, QUERIES).astype(int))]
    squared = (some**2).sum(1)[:, None] - 2 * some @ cloud.T + (cloud**2).sum(1)
    return np.sqrt(np.maximum(np.partition(squared, count, axis=1)[:, count], 0))


def _spacing(cloud: np.ndarray) -> float:
    away = _nearest(cloud, 4)
    return float(np.median(away)) if len(away) else 0.0


def _area(full: np.ndarray) -> float:
    """m^2, to about 20 %: of points strewn evenly over a surface, a disc to the k-th neighbour holds k of them.

    By the median disc, which has k - 1/3, so that rims and stray points do not count. Where points lie much denser on
    one part of the surface than on another, it is only an order of magnitude.
    """
    cloud = full[:: len(full) // LARGE + 1]
    away = _nearest(cloud, AREA)
    return float(len(cloud) * np.pi * np.median(away) ** 2 / (AREA - 1 / 3)) if len(away) else 0.0
