"""Estimate the part of a cloud's noise that neighbouring points share, from frames at rest.

A stereo camera errs by patches: all points of some centimetres lie too near or too far together, and elsewhere a moment
later. Distances of points from a local surface do not show this. While grippers and cloth stand still, the mean of a
patch shows it by its scatter from frame to frame. What never changes, e.g. a wrong scale of depth, no such frame shows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..recordings import PointClouds, Recording
from ..robots.paths import GripperPath  # pyright: ignore[reportMissingImports] - mapped from robots/ at installation
from .noise import (
    MAD_TO_STD,
    MIN_STILL_FRAMES,
    NoiseEstimate,
    estimate_cloud_noise,
    principal_axes,
    still_runs,
    subtract_quadrics,
)

MAX_MEAN_PATCHES = 40  # in a run
MAX_RUN_FRAMES = 60  # of a run, evenly chosen
MEAN_PATCH_POINTS = 20  # of a patch in a frame
MAX_CLOUD_POINTS_PER_FRAME = 1000  # among which a patch finds its points, so that it is wider than the noise
MAX_OFFSET_M = 0.05  # of a point of a patch along the patch's normal; farther ones are another layer
MAX_FAR_TO_NEAR_RATIO = 2.0  # scatter far from the grippers over scatter near them, of cloth at rest
MIN_PATCHES_PER_QUARTER = 3  # near the grippers, and far from them
MAX_OUTLIER_STDS = 3.0  # farther residuals are shortened to this
NO_REST = "not measurable without frames at rest"
STILL_MOVING = "not measurable: the cloth moves while the grippers stand still"
AT_REST = (
    f"scatter of the means of {MEAN_PATCH_POINTS} points from frame to frame, at rest; what never changes is not in it"
)
MAX_STATED_RATIO = 2.0  # of a stated noise to the estimate, either way


@dataclass(frozen=True)
class PatchNoise:
    """Part of the noise that the points of a patch share and that changes from frame to frame.

    Attributes:
        std: standard deviation along the surface's normal [m]; None: it could not be measured.
        frames: number of frames that were used.
        method: how it was measured, or why not.
    """

    std: float | None
    frames: int
    method: str


def estimate_patch_noise(clouds: PointClouds, still: np.ndarray, grippers: np.ndarray) -> PatchNoise:
    """Estimate the noise of patch means about their own mean over frames.

    The white noise of the points, which a mean has as well, is taken out. Cloth that swings on moves least near the
    grippers, whereas a camera errs everywhere. The estimate is made only where the nearest and the farthest quarter of
    the patches scatter alike.

    Args:
        clouds: T frames.
        still: [T] bool, frames in which all grippers stand still, without frozen ones.
        grippers: [T, G, 3] m, positions of the grippers that hold the cloth.
    """
    usable = still & (clouds.counts >= 2 * MEAN_PATCH_POINTS)
    variances, distances, frames = [], [], 0
    for run in still_runs(usable):
        indices = np.arange(run.start, run.stop)
        if len(indices) < MIN_STILL_FRAMES:
            continue
        indices = indices[np.unique(np.linspace(0, len(indices) - 1, MAX_RUN_FRAMES).astype(int))]
        variance, centre = _mean_variances([clouds.frame(int(i)) for i in indices])
        nearest = np.linalg.norm(centre[:, None] - grippers[indices[0]], axis=-1)
        variances.append(variance)
        distances.append(nearest.min(1) if nearest.shape[1] else np.full(len(centre), np.nan))
        frames += len(indices)
    if not frames or not np.isfinite(np.concatenate(distances)).all():
        return PatchNoise(None, 0, NO_REST)
    variance, distance = np.concatenate(variances), np.concatenate(distances)
    quarter = len(distance) // 4
    if quarter < MIN_PATCHES_PER_QUARTER:
        return PatchNoise(None, 0, NO_REST)
    order = np.argsort(distance)
    near, far = (float(variance[part, 0].mean()) for part in (order[:quarter], order[-quarter:]))
    if far > MAX_FAR_TO_NEAR_RATIO**2 * near:
        return PatchNoise(None, 0, STILL_MOVING)
    total, white = variance.mean(0)
    return PatchNoise(float(max(total - white, 0.0)) ** 0.5, frames, AT_REST)


def _mean_variances(frames: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return ([P, 2] m^2 the variance of patch means over frames and its part by white noise, [P, 3] m centres)."""
    frames = [frame[:: len(frame) // MAX_CLOUD_POINTS_PER_FRAME + 1] for frame in frames]
    middle = frames[len(frames) // 2]
    centre = middle[np.unique(np.linspace(0, len(middle) - 1, MAX_MEAN_PATCHES).astype(int))]
    around = middle - centre[:, None]
    nearest = _select_smallest(around, (around**2).sum(-1))
    axes = principal_axes(nearest - nearest.mean(1, keepdims=True))
    patches = []
    for cloud in frames:  # points near in the plane of the patch, however far the surface has moved along its normal
        u, v, w = np.moveaxis(np.einsum("pnj,pij->pni", cloud - centre[:, None], axes), -1, 0)
        distance = np.where(np.abs(w) < MAX_OFFSET_M, u**2 + v**2, np.inf)
        patch = _select_smallest(np.stack([u, v, w, distance], -1), distance)
        patches.append(np.where(np.isfinite(patch[..., -1:].max(1, keepdims=True)), patch, np.nan)[..., :3])
    pooled = np.stack(patches, 1)  # [P, T, N, 3]
    is_seen = np.isfinite(pooled).all((1, 2, 3))
    if not is_seen.any():
        return np.zeros((0, 2)), np.zeros((0, 3))
    pooled, centre = pooled[is_seen], centre[is_seen]
    residual = subtract_quadrics(*np.moveaxis(pooled.reshape(len(pooled), -1, 3), -1, 0)).reshape(pooled.shape[:3])
    scale = MAD_TO_STD * np.median(np.abs(residual), axis=(1, 2), keepdims=True)
    residual = np.clip(residual, -MAX_OUTLIER_STDS * scale, MAX_OUTLIER_STDS * scale)
    white = residual.var(2, ddof=1).mean(1) / MEAN_PATCH_POINTS
    return np.stack([residual.mean(2).var(1, ddof=1), white], 1), centre


def _select_smallest(rows: np.ndarray, key: np.ndarray) -> np.ndarray:
    """Return [P, ``MEAN_PATCH_POINTS``, D] the rows [P, N, D] with the smallest keys [P, N]."""
    index = np.argpartition(key, MEAN_PATCH_POINTS - 1, axis=1)[:, :MEAN_PATCH_POINTS]
    return np.take_along_axis(rows, index[..., None], 1)


def standing_frames(paths: dict[str, GripperPath], t: np.ndarray) -> np.ndarray:
    """Return [T] bool, whether all grippers stand still at times [T] s of the motion; False without grippers."""
    if not paths:
        return np.zeros(len(t), bool)
    return np.all([path.is_standing(t) for path in paths.values()], axis=0)


def gripper_positions(paths: dict[str, GripperPath], t: np.ndarray) -> np.ndarray:
    """Return [T, G, 3] m, the positions of the grippers at times [T] s of the motion."""
    return np.stack([path.at(t)[0] for path in paths.values()], 1) if paths else np.zeros((len(t), 0, 3))


def check_stated_noise(recording: Recording, paths: dict[str, GripperPath]) -> str | None:
    """Return a sentence if the noise that a recording states is far off what its clouds show; else None.

    Args:
        recording: an episode without frozen clouds, whose clock is right.
        paths: of the grippers that hold the cloth; empty: unknown.
    """
    points = recording.points
    if points is None or not recording.observation_noise_std:
        return None
    t = points.t + recording.clock_offset
    still = standing_frames(paths, t)
    white = estimate_cloud_noise(points, still if paths else None)
    patch = estimate_patch_noise(points, still, gripper_positions(paths, t))
    return describe_stated_noise(recording.observation_noise_std, white, patch)


def describe_stated_noise(stated: float | None, white: NoiseEstimate | None, patch: PatchNoise | None) -> str | None:
    """Return a sentence if a stated standard deviation of the points is far off the estimate; else None.

    Too small is what is less than half of the noise. Too large is what is more than twice the noise, its part over
    patches included: where that was not measured, nothing is too large.

    Args:
        stated: ``observation_noise.std`` [m]; None: not stated.
        white: noise off local surfaces.
        patch: noise that neighbouring points share.
    """
    if not stated or white is None or not white.is_resolved:
        return None
    shared = 0.0 if patch is None or patch.std is None else patch.std
    estimate = float(np.hypot(white.std, shared))
    is_too_small = stated * MAX_STATED_RATIO < estimate
    is_too_large = patch is not None and patch.std is not None and stated > MAX_STATED_RATIO * estimate
    if not (is_too_small or is_too_large):
        return None
    parts = f", of which {1e3 * shared:.2g} mm are shared by neighbouring points" if shared else ""
    relation = "less than half of" if is_too_small else "more than twice"
    return (
        f"the stated noise of the points, {1e3 * stated:.2g} mm, is {relation} what the clouds show, "
        f"{1e3 * estimate:.2g} mm{parts}: correct observation_noise.std"
    )
