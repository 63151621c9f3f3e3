"""Estimate sensor noise from frames in which the grippers stand still."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..recordings import Markers, PointClouds
from .nan_statistics import nan_median

MIN_STILL_FRAMES = 6  # in a run
MAX_SCATTER_TO_STEP_RATIO = 2.0  # scatter of coordinates over scatter of steps (1 for white noise) of cloth at rest
MAX_SCATTER_TO_QUIETEST_RATIO = 1.5  # scatter over that of the quietest run, of cloth at rest
PATCH_POINTS = 20  # of a local surface
MAX_GROWTH_WITH_PATCH = 1.25  # of the scatter if patches have twice the area, where wrinkles are no part of it
QUADRIC_COEFFICIENTS = 6
MAX_PATCHES, MAX_NOISE_FRAMES, MAX_CLOUD_POINTS = 200, 20, 20_000  # per frame, in all, among which neighbours are found
MAD_TO_STD = 1.4826  # standard deviation over median absolute deviation of a normal distribution


@dataclass(frozen=True)
class NoiseEstimate:
    """Standard deviation of a measured coordinate.

    Attributes:
        std: [m], for markers along the direction of largest scatter, for clouds along the surface's normal.
        std_xyz: [m], along x, y and z for markers; None for clouds.
        frames: number of frames that were used.
        method: how it was measured.
        is_resolved: whether the surface is smooth over a patch, so that wrinkles are no part of the noise: twice the
            area gives about the same.
    """

    std: float
    std_xyz: tuple[float, float, float] | None
    frames: int
    method: str
    is_resolved: bool = True


def estimate_marker_noise(markers: Markers, still: np.ndarray, use: np.ndarray) -> NoiseEstimate | None:
    """Estimate marker noise as the robust scatter about the mean position while the cloth is at rest.

    In each run of still frames, the scatter of coordinates is compared with the scatter of their steps. They agree only
    if the cloth is at rest. If no run is at rest, the steps between frames give an upper bound of the noise.

    Args:
        markers: the stream.
        still: [T] bool, frames in which all grippers stand still.
        use: [T] bool, frames that are not rejected.

    Returns:
        The median over the markers; None if it cannot be measured.
    """
    runs = [markers.xyz[run][use[run]] for run in still_runs(still)]
    runs = [xyz - nan_median(xyz, 0) for xyz in runs if len(xyz) >= MIN_STILL_FRAMES]
    runs = [xyz for xyz in runs if np.isfinite([_scatter(xyz), _scatter(np.diff(xyz, axis=0))]).all()]
    if not runs:
        return None
    scatter = [_scatter(xyz) for xyz in runs]
    step_scatter = [_scatter(np.diff(xyz, axis=0)) / np.sqrt(2) for xyz in runs]
    size, step_size = np.linalg.norm(scatter, axis=1), np.linalg.norm(step_scatter, axis=1)
    at_rest = np.flatnonzero(
        (size <= MAX_SCATTER_TO_STEP_RATIO * step_size) & (size <= MAX_SCATTER_TO_QUIETEST_RATIO * size.min())
    )
    if len(at_rest):
        deviations, method = [runs[k] for k in at_rest], "scatter about the mean position at rest"
    else:
        deviations = [np.diff(xyz, axis=0) / np.sqrt(2) for xyz in runs]
        method = "from steps between frames, as the cloth was never at rest: an upper bound"
    counts = [len(xyz) for xyz in deviations]
    direction = _noisiest_direction(np.concatenate(deviations).reshape(-1, 3))
    scatters = [_scatter(xyz @ np.column_stack([np.eye(3), direction])) for xyz in deviations]
    x, y, z, std = np.sqrt(np.average(np.square(scatters), axis=0, weights=counts)).tolist()
    return NoiseEstimate(std, (x, y, z), sum(counts), method)


def estimate_cloud_noise(clouds: PointClouds, still: np.ndarray | None) -> NoiseEstimate | None:
    """Estimate cloud noise as the robust scatter about quadrics through each point's neighbours.

    Wrinkles finer than a patch of 20 points count as noise, so the result is an upper bound for thinned clouds.

    Args:
        clouds: the stream.
        still: [T] bool, frames in which all grippers stand still, which are preferred; None: unknown.

    Returns:
        The noise along the surface's normal; None if no frame has enough points.
    """
    large_enough = np.flatnonzero(clouds.counts >= 2 * PATCH_POINTS)
    frames = large_enough[:0] if still is None else np.intersect1d(np.flatnonzero(still), large_enough)
    frames_text = "in still frames" if len(frames) else "in moving frames, because none is still"
    frames_text = "in all frames, because without grippers still frames are unknown" if still is None else frames_text
    frames = frames if len(frames) else large_enough
    if len(frames) == 0:
        return None
    frames = frames[np.unique(np.linspace(0, len(frames) - 1, MAX_NOISE_FRAMES).astype(int))]
    selected = [clouds.frame(int(i)) for i in frames]
    std = _scatter_off_surface(selected)
    thinned = [cloud[::2] for cloud in selected if len(cloud) >= 4 * PATCH_POINTS]
    is_resolved = bool(thinned) and _scatter_off_surface(thinned) < MAX_GROWTH_WITH_PATCH * std
    method = f"off local surfaces of {PATCH_POINTS} points, {frames_text}"
    return NoiseEstimate(std, None, len(frames), method, is_resolved)


def _scatter_off_surface(selected: list[np.ndarray]) -> float:
    """Return the robust standard deviation [m] of points off local surfaces."""
    return MAD_TO_STD * float(np.median(np.abs(np.concatenate([_off_surface(cloud) for cloud in selected]))))


def _off_surface(cloud: np.ndarray) -> np.ndarray:
    """Return the distances of points from the quadric through their neighbours, corrected for the fitted terms."""
    cloud = cloud[:: len(cloud) // MAX_CLOUD_POINTS + 1]
    centre = cloud[np.unique(np.linspace(0, len(cloud) - 1, MAX_PATCHES).astype(int))]
    squared_distance = ((centre[:, None] - cloud) ** 2).sum(-1)
    patch = cloud[np.argpartition(squared_distance, PATCH_POINTS - 1, axis=1)[:, :PATCH_POINTS]]
    patch = patch - patch.mean(1, keepdims=True)
    u, v, w = np.moveaxis(np.einsum("nkj,nij->nki", patch, principal_axes(patch)), -1, 0)
    return (subtract_quadrics(u, v, w) * np.sqrt(PATCH_POINTS / (PATCH_POINTS - QUADRIC_COEFFICIENTS))).ravel()


def principal_axes(patch: np.ndarray) -> np.ndarray:
    """Return [P, 3, 3] the principal axes of centred patches [P, N, 3] m as rows; the last is the normal."""
    return np.linalg.svd(patch, full_matrices=False)[2]


def subtract_quadrics(u: np.ndarray, v: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Return w [P, N] m less the quadrics in u and v [P, N] m that fit it best."""
    basis = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], -1)
    size = np.linalg.norm(basis, axis=1, keepdims=True)
    q, _ = np.linalg.qr(basis / np.where(size > 0, size, 1))
    return w - np.einsum("nki,nji,nj->nk", q, q, w, optimize=True)


def _scatter(deviation: np.ndarray) -> np.ndarray:
    """Return [D] the robust standard deviation of [T, M, D] over the frames, median over the markers."""
    seen_often = deviation[:, np.isfinite(deviation[..., 0]).sum(0) >= MIN_STILL_FRAMES - 1]
    if seen_often.shape[1] == 0:
        return np.full(deviation.shape[-1], np.nan)
    return MAD_TO_STD * np.median(nan_median(np.abs(seen_often - nan_median(seen_often, 0)), 0), axis=0)


def _noisiest_direction(deviation: np.ndarray) -> np.ndarray:
    """Return the unit direction [3] in which deviations [N, 3] scatter most; outliers are shortened."""
    seen = deviation[np.isfinite(deviation[:, 0])]
    size = np.linalg.norm(seen, axis=1, keepdims=True)
    seen = seen * np.minimum(1, 3 * np.median(size) / np.maximum(size, 1e-12))
    return np.linalg.eigh(seen.T @ seen)[1][:, -1]


def still_runs(still: np.ndarray) -> list[slice]:
    """Return the runs of still frames.

    Args:
        still: [T] bool.
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(int)))
    return [slice(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True)]
