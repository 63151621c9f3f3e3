"""Estimate the lag of observation stamps behind motion stamps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from types import MappingProxyType

import numpy as np

from ..recordings import Markers, PointClouds, Recording
from ..robots.paths import GripperPath  # pyright: ignore[reportMissingImports] - mapped from robots/ at installation
from .nan_statistics import nan_median

LAG_SEARCH_RANGE_S, COARSE_LAG_STEP_S = 1.0, 0.02  # to either side of the recorded lag
FINE_LAG_RANGE_S, FINE_LAG_STEP_S = 0.16, 0.004  # to either side of the coarse minimum
VALLEY_FRACTION = 0.1  # of the way from the smallest to the median misfit; lower values belong to the minimum
RESIDUAL_SCALE_M = 5e-3  # above, residuals count linearly instead of quadratically
GRIPPED_MARKER_FRACTION = 0.1  # of the markers, the nearest ones, are assumed to be gripped
MIN_SAMPLES = 3  # of markers, frames and candidates
GRIPPED_POINTS = 5  # of a cloud, the nearest ones, whose mean is assumed to be gripped
MAX_LAG_FRAMES, MAX_LAG_POINTS_PER_FRAME = 300, 1000  # used, evenly chosen
JACKKNIFE_BLOCKS = 10
MAX_LAG_STD_S = 0.05  # of a lag that is determined
MIN_COST_CONTRAST = 1.15  # median over smallest misfit, of a lag that is determined
MIN_DIFFERENCE_STDS, MIN_LAG_DIFFERENCE_S = 3.0, 0.02  # both must be exceeded by the difference from the recorded lag
MAX_RIVAL_P_VALUE = 0.01  # of a misfit that is larger by chance alone, below which another minimum is no rival
LAG_CAVEAT = (
    "it is the delay of the observed cloth near the grippers behind the grippers. It includes the delay of stamps, the "
    "delay of the cloth itself and that of a loose grip. At constant speed a lag is the same as an offset"
)


@dataclass(frozen=True, eq=False)
class LagEstimate:
    """Observation stamps minus motion stamps of the same event.

    Attributes:
        value: estimated lag [s].
        std: standard error [s]: a jackknife over blocks of time, which allows for correlated errors, combined with the
            bound from the misfit and the variation of the velocity.
        is_determined: whether the recording determines the lag. The minimum must lie inside the search range, the
            standard error below 0.05 s, and the misfit clearly below its median.
        rivals: other lags that explain the data as well [s], as those of a periodic motion do.
        recorded: lag according to the recording [s], minus its clock_offset.
        misfit: mean distance from rigid motion with the gripper at the minimum [m].
        candidates: [N] s, the lags that were tried.
        cost: [N] m, their misfits.
    """

    value: float
    std: float
    is_determined: bool
    rivals: tuple[float, ...]
    recorded: float
    misfit: float
    candidates: np.ndarray
    cost: np.ndarray

    @property
    def differs_from_recorded(self) -> bool:
        """Whether the lag is determined and differs significantly from the recorded lag."""
        tolerance = max(MIN_DIFFERENCE_STDS * self.std, MIN_LAG_DIFFERENCE_S)
        return self.is_determined and abs(self.value - self.recorded) > tolerance

    @property
    def effective(self) -> float:
        """Lag to correct for [s]: the estimate if it differs from the recorded lag, else the recorded lag."""
        return self.value if self.differs_from_recorded else self.recorded


def estimate_lag(
    recording: Recording,
    paths: dict[str, GripperPath],
    use: Mapping[str, np.ndarray] = MappingProxyType({}),
    is_one_clock: bool = True,
) -> LagEstimate | None:
    """Estimate the lag of the markers, or of the clouds if there are none; None without motion or observations.

    Observed points near a gripper are assumed to be fixed to it: x(t) = p(t - lag) + R(t - lag) b with a constant b.
    The markers or cloud points nearest to the gripper are used. The lag minimises the mean soft absolute value of the
    residuals over all grippers. Of several minima that the data cannot tell apart, it is the one nearest to the
    recorded lag, if all stamps are on one clock. A periodic motion has a minimum in each period.

    Args:
        recording: the episode.
        paths: of its grippers.
        use: [T] bool for "markers" and "points", frames that are not rejected.
        is_one_clock: whether the stamps are on one clock; else the recorded lag means nothing.
    """
    kind = "markers" if recording.markers is not None else "points"
    stream = getattr(recording, kind)
    if stream is None or not paths:
        return None
    usable = np.flatnonzero(use.get(kind, np.ones(len(stream.t), bool)))
    if len(usable) < JACKKNIFE_BLOCKS:
        return None
    frames = usable[np.unique(np.linspace(0, len(usable) - 1, MAX_LAG_FRAMES).astype(int))]
    follower = _MarkerFollower(stream, frames) if isinstance(stream, Markers) else _CloudFollower(stream, frames)
    t = stream.t[frames]
    candidates = _symmetric_grid(LAG_SEARCH_RANGE_S, COARSE_LAG_STEP_S) - recording.clock_offset
    recorded = 0.0 - recording.clock_offset
    curve = _curve(follower, paths, t, candidates)
    is_covered = np.isfinite(_frame_mean(curve))
    candidates, curve = candidates[is_covered], curve[:, is_covered]
    if len(candidates) < MIN_SAMPLES:
        return None
    cost = _frame_mean(curve)
    minima = _find_equal_minima(candidates, curve, cost)
    best = min(minima, key=lambda k: abs(candidates[k] - recorded) if is_one_clock else cost[k])
    rivals = tuple(float(candidates[k]) for k in minima if k != best)
    fine_candidates = candidates[best] + _symmetric_grid(FINE_LAG_RANGE_S, FINE_LAG_STEP_S)
    fine = _curve(follower, paths, t, fine_candidates)
    level = cost[best] + VALLEY_FRACTION * (np.median(cost) - cost[best])
    value = _parabola_vertex(fine_candidates, _frame_mean(fine), level)
    if not np.isfinite(value):
        return None
    block = np.arange(len(t)) * JACKKNIFE_BLOCKS // len(t)
    without_block = (_frame_mean(fine[block != k]) for k in range(JACKKNIFE_BLOCKS))
    replicates = np.array([_parabola_vertex(fine_candidates, curve, level) for curve in without_block])
    misfit = float(np.nanmin(_frame_mean(fine)))
    jackknife = np.sqrt((JACKKNIFE_BLOCKS - 1) / JACKKNIFE_BLOCKS * ((replicates - replicates.mean()) ** 2).sum())
    std = float(np.hypot(jackknife, misfit / max(_velocity_scatter(paths, t - value) * np.sqrt(len(t)), 1e-9)))
    is_interior = 0 < best < len(candidates) - 1
    is_determined = bool(is_interior and std < MAX_LAG_STD_S and np.median(cost) > MIN_COST_CONTRAST * cost[best])
    return LagEstimate(value, std, is_determined, rivals, recorded, misfit, candidates, cost)


def _symmetric_grid(half_range: float, step: float) -> np.ndarray:
    return np.arange(-half_range, half_range + step / 2, step)


def _find_equal_minima(candidates: np.ndarray, curve: np.ndarray, cost: np.ndarray) -> list[int]:
    """Return the index of the smallest misfit, and of other minima whose misfit may be larger by chance alone.

    The test flips the signs of the differences between blocks of frames.

    Args:
        candidates: [N] s.
        curve: [F, N] m, misfit of each frame.
        cost: [N] m, its mean over the frames.
    """
    best = int(np.argmin(cost))
    minima, signs = [best], np.array(list(product((-1, 1), repeat=JACKKNIFE_BLOCKS)))
    for k in 1 + np.flatnonzero((cost[1:-1] < cost[:-2]) & (cost[1:-1] <= cost[2:])):
        difference = curve[:, k] - curve[:, best]
        difference = difference[np.isfinite(difference)]
        if abs(candidates[k] - candidates[best]) <= FINE_LAG_RANGE_S or len(difference) < JACKKNIFE_BLOCKS:
            continue  # the same minimum, or nothing to compare
        blocks = np.array([block.mean() for block in np.array_split(difference, JACKKNIFE_BLOCKS)])
        if (signs @ blocks >= blocks.sum()).mean() > MAX_RIVAL_P_VALUE:
            minima.append(int(k))
    return minima


class _MarkerFollower:
    """Offsets of tracked points from a gripper, in axes that turn with it."""

    def __init__(self, markers: Markers, frames: np.ndarray) -> None:
        xyz = markers.xyz[frames]
        is_mostly_seen = np.isfinite(xyz[..., 0]).mean(0) > 0.5
        self.xyz = xyz[:, is_mostly_seen if is_mostly_seen.any() else slice(None)]

    def misfit(self, covered: np.ndarray, position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        """Return [C] m, the misfit of the nearest markers in the covered frames."""
        offset = np.einsum("fij,fmi->fmj", rotation, self.xyz[covered] - position[:, None])
        count = max(MIN_SAMPLES, int(GRIPPED_MARKER_FRACTION * offset.shape[1]))
        near = offset[:, np.argsort(nan_median((offset**2).sum(-1), 0))[:count]]
        deviation = _soft_absolute(near - nan_median(near, 0))
        seen = np.isfinite(deviation)
        mean = np.where(seen, deviation, 0.0).sum(1) / np.maximum(seen.sum(1), 1)
        return np.where(seen.any(1), mean, RESIDUAL_SCALE_M)


class _CloudFollower:
    """Offset of the nearest points from a gripper, in axes that turn with it."""

    def __init__(self, clouds: PointClouds, frames: np.ndarray) -> None:
        ends = np.cumsum(clouds.counts)
        self.clouds = []
        for i in frames:
            cloud = clouds.xyz[ends[i] - clouds.counts[i] : ends[i]]
            self.clouds.append(cloud[:: max(1, len(cloud) // MAX_LAG_POINTS_PER_FRAME)])

    def misfit(self, covered: np.ndarray, position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        """Return [C] m, the misfit of the nearest points in the covered frames."""
        offset = np.empty_like(position)
        for f, cloud in enumerate(self.clouds[k] for k in np.flatnonzero(covered)):
            deviation = ((cloud - position[f]) ** 2).sum(1)
            count = min(GRIPPED_POINTS, len(cloud))
            nearest = cloud[np.argpartition(deviation, count - 1)[:count]].mean(0)
            offset[f] = (nearest - position[f]) @ rotation[f]
        return _soft_absolute(offset - np.median(offset, axis=0))


def _curve(
    follower: _MarkerFollower | _CloudFollower, paths: dict[str, GripperPath], t: np.ndarray, candidates: np.ndarray
) -> np.ndarray:
    """Return the misfit [F, N] m of each frame and candidate, mean over the grippers; NaN outside of a path's time."""
    start, end = max(p.t[0] for p in paths.values()), min(p.t[-1] for p in paths.values())
    curve = np.full((len(t), len(candidates)), np.nan)
    for k, candidate in enumerate(candidates):
        covered = (t - candidate >= start) & (t - candidate <= end)
        if covered.sum() >= MIN_SAMPLES:
            poses = [_pose_since_start(path, t[covered] - candidate) for path in paths.values()]
            curve[covered, k] = np.mean([follower.misfit(covered, *pose) for pose in poses], axis=0)
    return curve


def _velocity_scatter(paths: dict[str, GripperPath], t: np.ndarray) -> float:
    """Return the standard deviation of the grippers' velocity [m/s].

    It determines the lag: at constant velocity a lag is the same as an offset.
    """
    step = 0.05
    speeds = [(path.at(t + step)[0] - path.at(t - step)[0]) / (2 * step) for path in paths.values()]
    start, end = max(p.t[0] for p in paths.values()) + step, min(p.t[-1] for p in paths.values()) - step
    is_interior = (t > start) & (t < end)
    return float(np.sqrt(np.mean([v[is_interior].var(0).sum() for v in speeds]))) if is_interior.sum() > 1 else 0.0


def _frame_mean(curve: np.ndarray) -> np.ndarray:
    """Return [N] the mean over the frames; NaN where the motion covers less than half of them."""
    seen = np.isfinite(curve)
    mean = np.where(seen, curve, 0.0).sum(0) / np.maximum(seen.sum(0), 1)
    return np.where(seen.mean(0) >= 0.5, mean, np.nan)


def _pose_since_start(path: GripperPath, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return position [m] and rotation since the start of the path; without rotation, axes stay those of the world."""
    position, rotation = path.at(t)
    return position, rotation @ path.rotation[0].T


def _soft_absolute(offset: np.ndarray) -> np.ndarray:
    """Return the misfit [...] m of offsets [..., 3] m: quadratic below the scale, linear above, for each axis.

    Axes are separate, so that an error across the motion, which no lag can remove, does not mask the one along it.
    """
    return RESIDUAL_SCALE_M * (np.sqrt(1 + (offset / RESIDUAL_SCALE_M) ** 2) - 1).sum(-1)


def _parabola_vertex(candidates: np.ndarray, cost: np.ndarray, level: float) -> float:
    """Return the vertex of a parabola through the values below ``level``, at least 5; NaN if there are too few."""
    candidates, cost = candidates[np.isfinite(cost)], cost[np.isfinite(cost)]
    if len(cost) < MIN_SAMPLES:
        return float("nan")
    order = np.argsort(cost)
    valley = cost <= max(level, cost[order[min(4, len(cost) - 1)]])
    a, b, _ = np.polyfit(candidates[valley], cost[valley], 2)
    vertex = -b / (2 * a) if a > 0 else candidates[order[0]]
    return float(np.clip(vertex, candidates[valley].min(), candidates[valley].max()))
