"""Check frames: which cannot show the cloth, how much of it each shows, and what is cropped or an outlier."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import MissingDependency, RecordingError
from ..observe import Segmentation, segment
from ..recordings import ClothInfo, Markers, PointClouds
from ..recordings.size_checks import cloth_size, cloud_diameter
from .crop_planes import find_crop_planes
from .nan_statistics import nan_median

SIZE_TOLERANCE = 0.1  # of the cloth's size, for frames that are accepted
MIN_POINT_FRACTION = 0.1  # of the median number of points; such a frame has lost most of the cloth
MAX_REPEATED_FRACTION = 0.01  # of the points; measured points are never equal, but those stored in 0.1 mm may be
MARKER_NEIGHBOURS = 4  # of a marker, whose distances are compared with the pattern
AREA_NEIGHBOURS = 8  # of a point, whose distance gives the density of points
CLUSTER_GAP_SPACINGS = 3.0  # times the median spacing, within which points belong to one cluster
MAX_AREA_QUERY_POINTS = 300  # whose neighbours are searched
MAX_AREA_POINTS = 20_000  # among which they are searched


@dataclass(frozen=True, eq=False)
class FrameChecks:
    """Checks of the frames of one stream.

    Attributes:
        rejected: [T] bool, frames that cannot show the cloth.
        criterion: how they were recognised.
        coverage: [T] fraction of the markers seen; for clouds, area seen divided by the cloth's area (NaN if unknown).
        removed: for clouds, number of points that each stage of a `Segmentation` removes from all frames.
        crop_planes: for clouds, bounds [m] at which they were cropped, e.g. {"z >": 0.075}.
    """

    rejected: np.ndarray
    criterion: str
    coverage: np.ndarray
    removed: dict[str, int]
    crop_planes: dict[str, float]


def check_marker_frames(markers: Markers, cloth: ClothInfo) -> FrameChecks:
    """Check frames of markers: their distances must agree with the cloth to 10 %.

    With ``uv``, the median ratio of neighbour distances to pattern distances is compared with 1. Without ``uv``, for a
    grid of markers (``extra["grid"]``, [rows, columns] in order) on a sheet, the median arc lengths of rows and columns
    are compared with the sheet's sides. Otherwise distances are compared with their own medians over time. A cloth that
    is folded between most of its markers looks too short.
    """
    seen = np.isfinite(markers.xyz[..., 0])
    if markers.uv is None and "grid" in markers.extra and cloth.sheet is not None:
        ratio = _grid_length_ratios(markers, cloth.sheet)
        criterion = "arc lengths of rows and columns against the sheet's sides"
    else:
        ratio, criterion = _neighbour_distance_ratios(markers)
    with np.errstate(invalid="ignore"):
        rejected = np.logical_not(np.all(np.abs(ratio - 1) <= SIZE_TOLERANCE, axis=-1))
    return FrameChecks(rejected, criterion, seen.mean(1), {}, {})


def _grid_length_ratios(markers: Markers, sheet: tuple[float, float]) -> np.ndarray:
    """Return [T, 2] median arc lengths of rows and columns, divided by the matching sides of the sheet."""
    grid_size = np.asarray(markers.extra["grid"])
    is_pair = grid_size.shape == (2,) and grid_size.dtype.kind in "iuf"
    is_valid = is_pair and bool((grid_size == np.round(grid_size)).all())
    if not is_valid or grid_size.min() < 2 or grid_size.prod() != markers.xyz.shape[1]:
        raise RecordingError(
            "markers: grid does not fit",
            got=grid_size.tolist(),
            expected=f"[rows, columns] of {markers.xyz.shape[1]} markers, at least two of each",
        )
    rows, columns = grid_size.astype(int).tolist()
    grid = markers.xyz.reshape(len(markers.t), rows, columns, 3)
    segments = {k: np.linalg.norm(np.diff(grid, axis=k), axis=-1) for k in (1, 2)}
    arcs = np.stack([nan_median(_sum_lengths(lengths, k), -1) for k, lengths in segments.items()], -1)
    typical = nan_median(arcs, 0)
    sides = np.array([sheet, sheet[::-1]])
    return arcs / sides[np.argmin(np.abs(sides - typical).sum(1))]


def _sum_lengths(pieces: np.ndarray, axis: int) -> np.ndarray:
    """Sum lengths along an axis; up to half of them may be unseen and count as the mean of the others."""
    seen = np.isfinite(pieces)
    has_enough = seen.mean(axis) >= 0.5
    mean = np.where(seen, pieces, 0.0).sum(axis) / np.maximum(seen.sum(axis), 1)
    return np.where(has_enough, mean * pieces.shape[axis], np.nan)


def _neighbour_distance_ratios(markers: Markers) -> tuple[np.ndarray, str]:
    """Return [T, 1] the median ratio of neighbour distances to their expected values, and how these were obtained."""
    xyz = markers.xyz
    if markers.uv is not None:
        reference, criterion = markers.uv, "distances of neighbours against the pattern"
    else:
        reference, criterion = nan_median(xyz, 0), "distances of neighbours against their medians, size unknown"
    reference_distance = np.linalg.norm(reference[:, None] - reference, axis=-1)
    np.fill_diagonal(reference_distance, np.inf)
    count = min(MARKER_NEIGHBOURS, len(reference_distance) - 1)
    if count < 1:
        return np.ones((len(xyz), 1)), "a single marker: nothing to compare"
    neighbours = np.argsort(reference_distance, axis=1)[:, :count]
    distance = np.linalg.norm(xyz[:, neighbours] - xyz[:, :, None], axis=-1).reshape(len(xyz), -1)
    if markers.uv is not None:
        expected = np.take_along_axis(reference_distance, neighbours, axis=1).ravel()
    else:
        expected = nan_median(distance, 0)
    with np.errstate(divide="ignore", invalid="ignore"):  # markers at one place
        ratio = np.where(expected > 0, distance / expected, np.nan)
    return nan_median(ratio, -1)[:, None], criterion


def check_cloud_frames(
    clouds: PointClouds, cloth: ClothInfo, gripper_positions: np.ndarray
) -> tuple[FrameChecks, list[str]]:
    """Check frames of clouds.

    Without outliers, none may exceed the cloth's diameter by more than 10 %, or lose nine tenths of the points that
    clouds usually have.

    Args:
        clouds: T frames.
        cloth: gives the cloth's size.
        gripper_positions: [T, G, 3] m in each frame; G may be 0.

    Returns:
        The checks, and notes on what could not be done.
    """
    inliers, removed, notes = [], {}, []
    for i in range(len(clouds)):
        cloud = clouds.frame(i)
        try:
            segmented = segment(cloud, _segmentation_for(cloud))
        except MissingDependency as error:
            inliers, removed = [clouds.frame(k) for k in range(len(clouds))], {}
            notes = [f"outliers not counted: {error}"]
            break
        inliers.append(segmented.points)
        removed = {stage: removed.get(stage, 0) + count for stage, count in segmented.removed.items()}
    length, area = cloth_size(cloth)
    extent = np.array([cloud_diameter(c) for c in inliers])
    seen = np.array([_surface_area(c) for c in inliers]) / (area or np.nan)
    criterion = "larger than the cloth, or a tenth of the usual points"
    if not length:
        criterion = "a tenth of the usual points; the cloth's size is unknown"
    rejected = np.greater(extent, (1 + SIZE_TOLERANCE) * length if length else np.inf) | (extent == 0)
    rejected |= clouds.counts < MIN_POINT_FRACTION * np.median(clouds.counts)
    if (note := describe_repeated_point(clouds)) is not None:
        notes.append(note)
    planes = find_crop_planes([clouds.frame(i) for i in range(len(clouds))], inliers, cloth, seen, gripper_positions)
    return FrameChecks(rejected, criterion, seen, removed, planes), notes


def describe_repeated_point(clouds: PointClouds) -> str | None:
    """Return a note if many points of frames lie exactly at one place, as where a sensor had no reading."""
    frame = np.repeat(np.arange(len(clouds)), clouds.counts)
    rows, counts = np.unique(np.column_stack([frame, clouds.xyz]), axis=0, return_counts=True)
    repeated = int(counts[counts > 1].sum())
    if repeated <= MAX_REPEATED_FRACTION * len(clouds.xyz):
        return None
    place = ", ".join(f"{x:.4g}" for x in rows[np.argmax(counts), 1:])
    share = f"{100 * repeated / len(clouds.xyz):.2g} %"
    return (
        f"{share} of the points repeat another of their frame, most of them at ({place}) m: "
        "where a sensor has no reading, it may give the place of its lens; leave these points out"
    )


def _segmentation_for(cloud: np.ndarray) -> Segmentation:
    """Return a segmentation that removes outliers and small clusters, scaled to the cloud's spacing."""
    return Segmentation(cluster_gap=max(0.01, CLUSTER_GAP_SPACINGS * _spacing(cloud)), cluster_core_points=4)


def _kth_neighbour_distances(cloud: np.ndarray, count: int) -> np.ndarray:
    """Return [Q] the distances [m] of some points to their ``count``-th neighbour."""
    if len(cloud) <= count:
        return np.zeros(0)
    cloud = cloud - cloud.mean(0)  # avoids cancellation in the squared distances
    queries = cloud[np.unique(np.linspace(0, len(cloud) - 1, MAX_AREA_QUERY_POINTS).astype(int))]
    squared = (queries**2).sum(1)[:, None] - 2 * queries @ cloud.T + (cloud**2).sum(1)
    return np.sqrt(np.maximum(np.partition(squared, count, axis=1)[:, count], 0))


def _spacing(cloud: np.ndarray) -> float:
    distance = _kth_neighbour_distances(cloud, 4)
    return float(np.median(distance)) if len(distance) else 0.0


def _surface_area(full_cloud: np.ndarray) -> float:
    """Estimate the area [m^2] of a cloud's surface to about 20 %.

    A disc that reaches to the k-th neighbour contains k points, if points are spread evenly over the surface. The
    median disc, which contains k - 1/3, is not affected by edges and outliers. If the density of points varies strongly
    over the surface, the result is only an order of magnitude.
    """
    cloud = full_cloud[:: len(full_cloud) // MAX_AREA_POINTS + 1]
    distance = _kth_neighbour_distances(cloud, AREA_NEIGHBOURS)
    return float(len(cloud) * np.pi * np.median(distance) ** 2 / (AREA_NEIGHBOURS - 1 / 3)) if len(distance) else 0.0
