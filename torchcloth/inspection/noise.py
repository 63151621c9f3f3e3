"""How much the sensor's readings scatter, from frames in which the grippers stand still."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..recordings import Markers, PointClouds
from .nan_statistics import median

SHORTEST = 6  # frames
QUIET = 2.0  # of a coordinate's scatter over that of its steps, 1 of white noise: beyond, the cloth was moving
ALIKE = 1.5  # times the scatter of the quietest stretch: beyond, too
PATCH = 20  # points of a local surface
QUADRIC = 6  # its unknowns
QUERIES, FRAMES, LARGE = 200, 20, 20_000  # points looked at closely, in so many frames, among so many points
TO_SIGMA = 1.4826  # of the median absolute deviation


@dataclass(frozen=True)
class Noise:
    """One standard deviation of a coordinate, in m.

    Attributes:
        std: of markers, along the direction in which they scatter most; of clouds, along the surface's normal.
        axes: x, y, z of markers; None of clouds.
        frames: how many it was measured on.
        method: what was done.
    """

    std: float
    axes: tuple[float, float, float] | None
    frames: int
    method: str


def of_markers(markers: Markers, still: np.ndarray, use: np.ndarray) -> Noise | None:
    """Robust scatter of each marker about its place in each stretch of still frames; the median over markers.

    A stretch counts where coordinates scatter as much as their steps say, which they do only if the cloth hangs still.
    If none does, the steps between frames must do, and bound the noise from above.

    Args:
        markers: the stream.
        still: [T] bool, frames in which all grippers stand.
        use: [T] bool, frames that are not rejected.
    """
    stretches = [markers.xyz[stretch][use[stretch]] for stretch in _stretches(still)]
    stretches = [xyz - median(xyz, 0) for xyz in stretches if len(xyz) >= SHORTEST]
    told = lambda xyz: np.isfinite([_scatter(xyz), _scatter(np.diff(xyz, axis=0))]).all()  # noqa: E731
    stretches = [xyz for xyz in stretches if told(xyz)]
    if not stretches:
        return None
    about = [_scatter(xyz) for xyz in stretches]
    steps = [_scatter(np.diff(xyz, axis=0)) / np.sqrt(2) for xyz in stretches]
    size, size_of_steps = np.linalg.norm(about, axis=1), np.linalg.norm(steps, axis=1)
    quiet = np.flatnonzero((size <= QUIET * size_of_steps) & (size <= ALIKE * size.min()))
    if len(quiet):
        chosen, method = [stretches[k] for k in quiet], "about their place while all stands"
    else:
        chosen = [np.diff(xyz, axis=0) / np.sqrt(2) for xyz in stretches]
        method = "from steps, as the cloth never hung still: at most this"
    count = [len(xyz) for xyz in chosen]
    direction = _noisiest(np.concatenate(chosen).reshape(-1, 3))
    along = [_scatter(xyz @ np.column_stack([np.eye(3), direction])) for xyz in chosen]
    x, y, z, std = np.sqrt(np.average(np.square(along), axis=0, weights=count)).tolist()
    return Noise(std, (x, y, z), sum(count), method)


def of_clouds(clouds: PointClouds, still: np.ndarray | None) -> Noise | None:
    """Robust scatter about quadrics through each point's neighbours, by preference in still frames (None: not known).

    Wrinkles finer than a patch of 20 points count as noise: of a thinned cloud it is an upper bound.
    """
    big = np.flatnonzero(clouds.counts >= 2 * PATCH)
    frames = big[:0] if still is None else np.intersect1d(np.flatnonzero(still), big)
    where = "in still frames" if len(frames) else "in moving frames, as none is still"
    where = "in all frames, as no gripper tells which are still" if still is None else where
    frames = frames if len(frames) else big
    if len(frames) == 0:
        return None
    frames = frames[np.unique(np.linspace(0, len(frames) - 1, FRAMES).astype(int))]
    residual = np.concatenate([_off_surface(clouds.frame(int(i))) for i in frames])
    std = TO_SIGMA * float(np.median(np.abs(residual)))
    return Noise(std, None, len(frames), f"off local surfaces of {PATCH} points, {where}")


def _off_surface(cloud: np.ndarray) -> np.ndarray:
    """Distances of points from the quadric through their neighbours, scaled to what the sensor's own error is."""
    cloud = cloud[:: len(cloud) // LARGE + 1]
    centre = cloud[np.unique(np.linspace(0, len(cloud) - 1, QUERIES).astype(int))]
    away = ((centre[:, None] - cloud) ** 2).sum(-1)
    patch = cloud[np.argpartition(away, PATCH - 1, axis=1)[:, :PATCH]]
    patch = patch - patch.mean(1, keepdims=True)
    axes = np.linalg.svd(patch, full_matrices=False)[2]
    u, v, w = np.moveaxis(np.einsum("nkj,nij->nki", patch, axes), -1, 0)
    basis = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], -1)
    size = np.linalg.norm(basis, axis=1, keepdims=True)
    q, _ = np.linalg.qr(basis / np.where(size > 0, size, 1))
    residual = w - np.einsum("nki,nji,nj->nk", q, q, w)
    return (residual * np.sqrt(PATCH / (PATCH - QUADRIC))).ravel()


def _scatter(deviation: np.ndarray) -> np.ndarray:
    """[D] robust standard deviation of [T, M, D] over the frames; the median over the markers."""
    well = deviation[:, np.isfinite(deviation[..., 0]).sum(0) >= SHORTEST - 1]
    if well.shape[1] == 0:
        return np.full(deviation.shape[-1], np.nan)
    return TO_SIGMA * np.median(median(np.abs(well - median(well, 0)), 0), axis=0)


def _noisiest(deviation: np.ndarray) -> np.ndarray:
    """Unit direction [3] in which [N, 3] scatter most, far ones pulled in."""
    seen = deviation[np.isfinite(deviation[:, 0])]
    size = np.linalg.norm(seen, axis=1, keepdims=True)
    seen = seen * np.minimum(1, 3 * np.median(size) / np.maximum(size, 1e-12))
    return np.linalg.eigh(seen.T @ seen)[1][:, -1]


def _stretches(still: np.ndarray) -> list[slice]:
    """Runs of frames that are still."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(int)))
    return [slice(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True)]
