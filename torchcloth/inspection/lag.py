"""How much later the observations are stamped than the motion that they show."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from ..recordings import Markers, PointClouds, Recording
from ..robots.paths import GripperPath  # pyright: ignore[reportMissingImports] - mapped from robots/ at installation
from .nan_statistics import median

SEARCH, COARSE = 1.0, 0.02  # s to either side; step
NEAR, FINE = 0.16, 0.004  # the same about the least
VALLEY = 0.1  # of the way from the least misfit to the usual, below which the minimum's valley lies
SCALE = 5e-3  # m, beyond which a residual counts less
SHARE, FEWEST = 0.1, 3  # of the markers, that are taken to be held
NEAREST = 5  # points of a cloud, whose mean is taken to be held
FRAMES, POINTS = 300, 1000  # looked at, at most
BLOCKS = 10  # left out in turn
WORST = 0.05  # s of standard error, and
CONTRAST = 1.15  # of the usual misfit over the least, beyond which a lag is none
CLEARLY, LEAST = 3.0, 0.02  # standard errors and s, by which a lag is another than the stated one
CANNOT = (
    "it is what the observed cloth near the grippers does later than the grippers: delay of stamps, of the cloth's "
    "own follow-up and of a loose grip are one; of a motion at constant speed it is not told apart from an offset"
)


@dataclass(frozen=True, eq=False)
class Lag:
    """Observation stamps minus motion stamps of the same event.

    Attributes:
        value: s.
        std: s, standard error: stretches of the recording left out in turn (jackknife), which allows for errors that
            last, and what the misfit and the unsteadiness of the motion allow at best.
        told: whether the recording tells it: a minimum inside the search, a standard error below 0.05 s, and a misfit
            clearly below the usual.
        stated: s, what the recording says (minus its clock_offset).
        misfit: m, mean distance from the rigid follow-up at the least.
        tried, cost: [N] s and [N] m, the curve whose minimum it is.
    """

    value: float
    std: float
    told: bool
    stated: float
    misfit: float
    tried: np.ndarray
    cost: np.ndarray

    @property
    def differs(self) -> bool:
        """Whether it is told, and clearly another than what the recording says."""
        return self.told and abs(self.value - self.stated) > max(CLEARLY * self.std, LEAST)

    @property
    def trusted(self) -> float:
        """s, to move observations by: the value where it differs, else what the recording says."""
        return self.value if self.differs else self.stated


def lag(
    recording: Recording, paths: dict[str, GripperPath], use: Mapping[str, np.ndarray] = MappingProxyType({})
) -> Lag | None:
    """The lag of markers, or else of the clouds; None without motion or observations.

    Observed points near a gripper follow it as if they were fixed to it: x(t) = p(t - lag) + R(t - lag) b with a
    constant b. The markers, or points of a cloud, that are nearest to the gripper are taken. The lag is
    where the residuals' mean soft absolute value is least, over all grippers.

    Args:
        recording: the episode.
        paths: of its grippers.
        use: [T] bool of "markers" and "points", frames that are not rejected.
    """
    kind = "markers" if recording.markers is not None else "points"
    stream = getattr(recording, kind)
    if stream is None or not paths:
        return None
    good = np.flatnonzero(use.get(kind, np.ones(len(stream.t), bool)))
    if len(good) < BLOCKS:
        return None
    frames = good[np.unique(np.linspace(0, len(good) - 1, FRAMES).astype(int))]
    follow = _MarkersFollow(stream, frames) if isinstance(stream, Markers) else _CloudFollows(stream, frames)
    t = stream.t[frames]
    tried = np.arange(-SEARCH, SEARCH + COARSE / 2, COARSE) - recording.clock_offset
    cost = _mean(_curve(follow, paths, t, tried))
    tried, cost = tried[np.isfinite(cost)], cost[np.isfinite(cost)]
    if len(cost) < FEWEST:
        return None
    best = int(np.argmin(cost))
    close = tried[best] + np.arange(-NEAR, NEAR + FINE / 2, FINE)
    fine = _curve(follow, paths, t, close)
    level = cost[best] + VALLEY * (np.median(cost) - cost[best])
    value = _bottom(close, _mean(fine), level)
    if not np.isfinite(value):
        return None
    block = np.arange(len(t)) * BLOCKS // len(t)
    others = np.array([_bottom(close, _mean(fine[block != k]), level) for k in range(BLOCKS)])
    misfit = float(np.nanmin(_mean(fine)))
    jackknife = np.sqrt((BLOCKS - 1) / BLOCKS * ((others - others.mean()) ** 2).sum())
    std = float(np.hypot(jackknife, misfit / max(_unsteady(paths, t - value) * np.sqrt(len(t)), 1e-9)))
    inside = 0 < best < len(tried) - 1
    told = bool(inside and std < WORST and np.median(cost) > CONTRAST * cost[best])
    return Lag(value, std, told, 0.0 - recording.clock_offset, misfit, tried, cost)


class _MarkersFollow:
    """Offsets of tracked points from a gripper, in axes that turn with it."""

    def __init__(self, markers: Markers, frames: np.ndarray) -> None:
        xyz = markers.xyz[frames]
        well = np.isfinite(xyz[..., 0]).mean(0) > 0.5
        self.xyz = xyz[:, well if well.any() else slice(None)]

    def misfit(self, covered: np.ndarray, position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        """[C] m of the markers that are nearest, in the covered frames."""
        offset = np.einsum("fij,fmi->fmj", rotation, self.xyz[covered] - position[:, None])
        count = max(FEWEST, int(SHARE * offset.shape[1]))
        near = offset[:, np.argsort(median((offset**2).sum(-1), 0))[:count]]
        away = _soft(near - median(near, 0))
        seen = np.isfinite(away)
        return np.where(seen.any(1), np.where(seen, away, 0.0).sum(1) / np.maximum(seen.sum(1), 1), SCALE)


class _CloudFollows:
    """Offset of the nearest points from a gripper, in axes that turn with it."""

    def __init__(self, clouds: PointClouds, frames: np.ndarray) -> None:
        ends = np.cumsum(clouds.counts)
        self.clouds = []
        for i in frames:
            cloud = clouds.xyz[ends[i] - clouds.counts[i] : ends[i]]
            self.clouds.append(cloud[:: max(1, len(cloud) // POINTS)])

    def misfit(self, covered: np.ndarray, position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        """[C] m, in the covered frames."""
        offset = np.empty_like(position)
        for f, cloud in enumerate(self.clouds[k] for k in np.flatnonzero(covered)):
            away = ((cloud - position[f]) ** 2).sum(1)
            count = min(NEAREST, len(cloud))
            nearest = cloud[np.argpartition(away, count - 1)[:count]].mean(0)
            offset[f] = (nearest - position[f]) @ rotation[f]
        return _soft(offset - np.median(offset, axis=0))


def _curve(
    follow: _MarkersFollow | _CloudFollows, paths: dict[str, GripperPath], t: np.ndarray, tried: np.ndarray
) -> np.ndarray:
    """Misfit [F, N] m, mean over the grippers; NaN where a path does not reach."""
    start, end = max(p.t[0] for p in paths.values()), min(p.t[-1] for p in paths.values())
    out = np.full((len(t), len(tried)), np.nan)
    for k, by in enumerate(tried):
        covered = (t - by >= start) & (t - by <= end)
        if covered.sum() >= FEWEST:
            each = [follow.misfit(covered, *_turned(path, t[covered] - by)) for path in paths.values()]
            out[covered, k] = np.mean(each, axis=0)
    return out


def _unsteady(paths: dict[str, GripperPath], t: np.ndarray) -> float:
    """Standard deviation of the grippers' velocity, m/s: what a lag shows against, as a mean velocity is an offset."""
    step = 0.05
    speeds = [(path.at(t + step)[0] - path.at(t - step)[0]) / (2 * step) for path in paths.values()]
    start, end = max(p.t[0] for p in paths.values()) + step, min(p.t[-1] for p in paths.values()) - step
    inside = (t > start) & (t < end)
    return float(np.sqrt(np.mean([v[inside].var(0).sum() for v in speeds]))) if inside.sum() > 1 else 0.0


def _mean(curve: np.ndarray) -> np.ndarray:
    """[N] mean over the frames; NaN where the motion covers less than half of them."""
    seen = np.isfinite(curve)
    mean = np.where(seen, curve, 0.0).sum(0) / np.maximum(seen.sum(0), 1)
    return np.where(seen.mean(0) >= 0.5, mean, np.nan)


def _turned(path: GripperPath, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Position, and rotation since the start of the path: with it, axes stay the world's as long as nothing turns."""
    position, rotation = path.at(t)
    return position, rotation @ path.rotation[0].T


def _soft(offset: np.ndarray) -> np.ndarray:
    """Misfit [...] m of offsets [..., 3] m: quadratic below SCALE, linear beyond, axis by axis.

    By axis, so that an error across the motion, which no lag mends, does not drown the one along it.
    """
    return SCALE * (np.sqrt(1 + (offset / SCALE) ** 2) - 1).sum(-1)


def _bottom(tried: np.ndarray, cost: np.ndarray, level: float) -> float:
    """Vertex of the parabola through the valley: what lies below the level, 5 values at least; NaN of too few."""
    tried, cost = tried[np.isfinite(cost)], cost[np.isfinite(cost)]
    if len(cost) < FEWEST:
        return float("nan")
    order = np.argsort(cost)
    valley = cost <= max(level, cost[order[min(4, len(cost) - 1)]])
    a, b, _ = np.polyfit(tried[valley], cost[valley], 2)
    vertex = -b / (2 * a) if a > 0 else tried[order[0]]
    return float(np.clip(vertex, tried[valley].min(), tried[valley].max()))
