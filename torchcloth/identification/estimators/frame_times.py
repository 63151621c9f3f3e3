"""Times of single frames as unknowns: when the stamps of a camera scatter, each frame shows the cloth at another time.

The error of one stamp touches the rows of its own frame only. So it is no unknown of the search. It is marginalised
frame by frame: rows r, with slopes c by the frame's time, weights w and information i = sum w c^2, are taken at the
time b t, where t fits the frame best. Their slopes J lose b c (c w J) / i. With 1 - b = (1 + s^2 i)^(-1/2) the rows'
weighted squares are those of generalised least squares, with stamps of standard deviation s. Without information b is
0, and the stamp counts.

The standard deviation s comes from the data. A wrong model moves the best times of neighbouring frames alike; stamps
that scatter do not. So the differences from neighbours show it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from ...episodes.observed import Episode
from ...episodes.observed_surface import ObservedSurface
from ...episodes.replay import Frames, see_at
from ..residuals.blocks import Block
from ..residuals.metrics import huber
from ..residuals.rows import ResidualRows, match_points


@dataclass(frozen=True)
class FrameTimeSettings:
    """How times of frames are sought, and when stamps count as scattered.

    Attributes:
        max_iterations: Gauss-Newton steps for the times.
        max_shift_stds: of a frame's time, in standard deviations of the stamps.
        wide_std_s: of the stamps [s], with which the times are sought that show the standard deviation.
        min_std_s: of the stamps [s], below which they count as exact.
        min_excess_stds: by which the scatter of the best times must exceed its own error.
        min_differences: number of differences from neighbouring frames that can show it.
    """

    max_iterations: int = 4
    max_shift_stds: float = 3.0
    wide_std_s: float = 0.06
    min_std_s: float = 2e-3
    min_excess_stds: float = 3.0
    min_differences: int = 8


FRAME_TIME_SETTINGS = FrameTimeSettings()
BISECTION_COUNT = 30  # of the stamps' standard deviation
CAMERA_BLOCKS = ("points", "edges", "markers")  # whose data are on the camera's clock


@dataclass(frozen=True)
class RowNoise:
    """How rows of a block are weighed.

    Attributes:
        scale: standard deviation of a residual.
        fraction: effective over nominal number of observations.
        cutoff: of outliers, in standard deviations.
    """

    scale: float
    fraction: float
    cutoff: float

    def weights(self, residual: Tensor, *, with_outliers: bool = False) -> Tensor:
        """Return the weights [R] of residuals; outliers have none, unless they are to count."""
        z = residual / self.scale
        return self.fraction * huber(z, math.inf if with_outliers else self.cutoff)[1] / self.scale**2


class Scene(NamedTuple):
    """What frames are compared with.

    Attributes:
        episode: the measurements.
        surface: the cloth's surface as data see it.
        blocks: kinds of data in use.
    """

    episode: Episode
    surface: ObservedSurface
    blocks: Sequence[Block]


class TimeSlopes(NamedTuple):
    """What the rows of an episode say about the times of its frames.

    Attributes:
        information: [T] 1/s^2.
        score: [T] 1/s, weighted slopes times residuals.
    """

    information: Tensor
    score: Tensor


@dataclass(frozen=True)
class FrameTimes:
    """Stamps that scatter.

    Attributes:
        std: standard deviation of a stamp [s].
        noise: of the rows, by block name.
        settings: of the search for the times.
    """

    std: float
    noise: dict[str, RowNoise]
    settings: FrameTimeSettings = FRAME_TIME_SETTINGS

    @torch.no_grad()
    def find_shifts(self, frames: Frames, scene: Scene) -> Tensor:
        """Return how long after its stamp each frame is to be seen, [T] s; for derivatives these are constants."""
        shift, longest = torch.zeros_like(scene.episode.times), self.settings.max_shift_stds * self.std
        for _ in range(self.settings.max_iterations):
            slopes = self.sum_rows(see_at(frames, scene.episode.times, shift), scene)
            share = self.share(slopes.information)
            shift = (share * shift - self.gain(slopes.information) * slopes.score).clamp(-longest, longest)
        return shift

    def share(self, information: Tensor) -> Tensor:
        """Return the share [T] of a frame's best time that counts."""
        return 1 - (1 + self.std**2 * information) ** -0.5

    def sum_rows(self, frames: Frames, scene: Scene) -> TimeSlopes:
        """Sum up what the rows say about the times of the frames."""
        simulated = match_points(frames, time_derivatives(frames), scene.episode, scene.surface)
        sums = frames.x.new_zeros(2, len(frames.x))
        for block in (block for block in scene.blocks if block.name in CAMERA_BLOCKS):
            rows = block.rows(simulated)
            if rows is not None:
                slope = _require(rows.jacobian)[:, 0]
                # at a wrong time all points of a frame may be far away
                weighted = self.noise[block.name].weights(rows.residual, with_outliers=True) * slope
                sums = sums.index_add(1, rows.frame, torch.stack([weighted * slope, weighted * rows.residual]))
        return TimeSlopes(*sums)

    def project(self, frames: Frames, derivatives: Frames, scene: Scene) -> dict[str, ResidualRows | None]:
        """Compute rows by block name, whose slopes say that the times of the frames follow the unknowns.

        Args:
            frames: at the times that count.
            derivatives: of them at these times, with K in front.
            scene: what they are compared with.
        """
        joined = join_derivatives(derivatives, time_derivatives(frames))
        simulated = match_points(frames, joined, scene.episode, scene.surface)
        rows = {block.name: block.rows(simulated) for block in scene.blocks}
        seen = {name: r for name, r in rows.items() if r is not None and name in CAMERA_BLOCKS}
        totals = frames.x.new_zeros(len(frames.x), len(derivatives.x) + 1)
        for name, r in seen.items():
            jacobian = _require(r.jacobian)
            weighted = self.noise[name].weights(r.residual) * jacobian[:, -1]
            totals = totals.index_add(0, r.frame, weighted[:, None] * jacobian)
        gain = self.gain(totals[:, -1])[:, None] * totals[:, :-1]
        for name, r in rows.items():
            if r is not None:
                jacobian = _require(r.jacobian)
                change = jacobian[:, -1:] * gain[r.frame] if name in seen else 0
                rows[name] = r._replace(jacobian=jacobian[:, :-1] - change)
        return rows

    def gain(self, information: Tensor) -> Tensor:
        """Return the share of a frame's best time over its information [T], which has a limit where there is none."""
        return torch.where(information > 0, self.share(information) / information, 0.5 * self.std**2)


def time_derivatives(frames: Frames) -> Frames:
    """Return the derivatives of what a camera sees by time, with a 1 in front."""
    wrench = {name: torch.zeros_like(w)[None] for name, w in frames.wrench.items()}
    zero = torch.zeros_like(frames.rim_offset)[None]
    return Frames(frames.v[None], torch.zeros_like(frames.v)[None], wrench, zero)


def join_derivatives(first: Frames, second: Frames) -> Frames:
    """Return derivatives by some unknowns, then by others."""
    wrench = {name: torch.cat([w, second.wrench[name]]) for name, w in first.wrench.items()}
    x, v, rim = (torch.cat([getattr(d, name) for d in (first, second)]) for name in ("x", "v", "rim_offset"))
    return Frames(x, v, wrench, rim)


def estimate_stamp_std(times: FrameTimes, frames: Sequence[Frames], scenes: Sequence[Scene]) -> float:
    """Return the standard deviation of the stamps [s]; 0 where they show none.

    The best time of a frame is compared with what its neighbours' best times interpolate to. The standard deviation is
    the one with which the squares of these differences are as large as expected (Paule and Mandel 1982).

    Args:
        times: with the noise of the rows.
        frames: [T, ...] of every episode, simulated.
        scenes: of every episode.
    """
    wide, settings = replace(times, std=times.settings.wide_std_s), times.settings
    squares, variances, factors = [], [], []
    for seen, scene in zip(frames, scenes, strict=True):
        stamps, shift = scene.episode.times, wide.find_shifts(seen, scene)
        information = wide.sum_rows(see_at(seen, stamps, shift), scene).information
        shows = (wide.std**2 * information > 1).nonzero().squeeze(-1)
        best, variance, t = (shift / wide.share(information))[shows], 1 / information[shows], stamps[shows]
        before = ((t[2:] - t[1:-1]) / (t[2:] - t[:-2])).to(best)  # weight of the earlier neighbour
        after = 1 - before
        squares.append((best[1:-1] - before * best[:-2] - after * best[2:]).square())
        variances.append(variance[1:-1] + before**2 * variance[:-2] + after**2 * variance[2:])
        factors.append(1 + before**2 + after**2)
    square, variance, factor = torch.cat(squares), torch.cat(variances), torch.cat(factors)
    count = len(square)

    def excess(std: float) -> float:
        return float((square / (variance + factor * std**2)).sum()) - count

    # neighbouring differences share frames, so the sum of count squares has a variance of 4 instead of 2 counts
    if count < settings.min_differences or excess(0.0) < settings.min_excess_stds * (4 * count) ** 0.5:
        return 0.0
    low, high = 0.0, wide.std
    for _ in range(BISECTION_COUNT):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if excess(middle) > 0 else (low, middle)
    return high if high > settings.min_std_s else 0.0


def _require(jacobian: Tensor | None) -> Tensor:
    assert jacobian is not None
    return jacobian
