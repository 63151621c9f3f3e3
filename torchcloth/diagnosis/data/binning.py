"""Residuals as means over bins: a part of the fabric, or a sensor, times a time window of 0.2 s.

Thousands of points hold a few hundred independent numbers. Means have little noise, so what is left in them is mostly
model error.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ...episodes.observed import Episode
from ...episodes.observed_surface import ERROR_GROUPS_PER_AXIS, ObservedSurface
from ...episodes.replay import Frames
from ...identification.residuals.blocks import RESIDUAL_BLOCKS
from ...identification.residuals.rows import ResidualRows, match_points

BIN_SECONDS = 0.2  # length of a time window [s]
MAX_BINS = 1000  # time windows of an episode
OUTLIER_ROBUST_STDS = (
    5.0  # distance from the bin's median, in robust standard deviations, beyond which a row is dropped
)
MIN_ROWS_PER_BIN = 3  # fewer rows make no bin, where bins usually have more
MAX_SENSORS = 1000  # grippers times axes
CHANNELS_PER_BLOCK = 10_000  # spacing of the keys of two kinds of data
MAD_TO_STD = 1.4826  # median absolute deviation to standard deviation of a normal distribution
BLOCK_NAMES = tuple(block.name for block in RESIDUAL_BLOCKS)
FORCE_BLOCK = BLOCK_NAMES.index("force")  # blocks before it are positions, it and later ones are measured by grippers


class BinnedResiduals(NamedTuple):
    """Mean residuals of one episode in B bins, with derivatives along K directions.

    Attributes:
        value: [B] mean residual, measured minus simulated [m, N or N m].
        jacobian: [B, K] derivatives of the residual.
        count: [B] rows in the bin.
        row_std: [B] standard deviation of a row within the bin.
        block: [B] int64, kind of data as an index of ``BLOCK_NAMES``.
        channel: [B] int64, three times the part of the fabric, piece of the rim or gripper, plus the axis.
        window: [B] int64, time window.
        rest_position: [B, 3] place on the fabric at rest [m]; zero for forces and torques.
        time: [B] mean time [s].
        roughness: [B] second difference along the parameters' steps, see ``linearise``; zero if not computed.
        depth_slope: [B] derivative of the residual along the depth of the only camera; zero if it does not see it.
    """

    value: Tensor
    jacobian: Tensor
    count: Tensor
    row_std: Tensor
    block: Tensor
    channel: Tensor
    window: Tensor
    rest_position: Tensor
    time: Tensor
    roughness: Tensor
    depth_slope: Tensor

    @property
    def key(self) -> Tensor:
        """[B] identifier of a bin, the same in all models."""
        return (self.block * CHANNELS_PER_BLOCK + self.channel) * MAX_BINS + self.window

    def select(self, index: Tensor | slice) -> BinnedResiduals:
        """Return the bins of a mask, of indices or of a slice."""
        return BinnedResiduals(*(column[index] for column in self))


class EpisodeEvidence(NamedTuple):
    """Residuals and derivatives of one episode.

    Attributes:
        bins: columns of the Jacobian: the model's coordinates, hypotheses that could be simulated, nuisances.
        nuisance_stds: [N] standard deviations of the nuisances.
        mesh_difference: [B] residual on the coarse mesh minus residual on the fine mesh.
        is_simulated: [hypotheses] bool, whether the hypothesis could be simulated.
    """

    bins: BinnedResiduals
    nuisance_stds: Tensor
    mesh_difference: Tensor
    is_simulated: Tensor


def time_blocks(episodes: Sequence[BinnedResiduals]) -> Tensor:
    """Return [B] numbers of the time blocks: bins of one episode, kind of data and time window."""
    labels = [torch.stack([torch.full_like(b.window, k), b.block, b.window], 1) for k, b in enumerate(episodes)]
    return torch.cat(labels).unique(dim=0, return_inverse=True)[1]


def align_rows(key: Tensor, other: Tensor, columns: Tensor) -> Tensor:
    """Return rows of ``columns`` in the order of ``key``.

    Args:
        key: [B] keys of the rows that are wanted.
        other: [O] keys of the rows of ``columns``.
        columns: [O, ...] values.

    Returns:
        [B, ...] values, zero where ``other`` has no such key.
    """
    if not len(other):
        return columns.new_zeros(len(key), *columns.shape[1:])
    order = torch.argsort(other)
    index = order[torch.searchsorted(other[order], key).clamp(max=len(other) - 1)]
    rows = columns[index].clone()
    rows[other[index] != key] = 0.0
    return rows


def average_groups(group: Tensor, values: Tensor) -> Tensor:
    """Return [B] the mean of ``values`` [B] over each bin's group [B]."""
    count = torch.bincount(group)
    return (values.new_zeros(len(count)).index_add(0, group, values) / count)[group]


def bin_residuals(
    frames: Frames, derivatives: Frames | None, episode: Episode, surface: ObservedSurface, rest_positions: Tensor
) -> BinnedResiduals:
    """Compute the binned residuals of a simulated episode.

    Args:
        frames: the simulation.
        derivatives: of the frames along K directions; None: no directions.
        episode: the measurements.
        surface: surface with its parts and rim.
        rest_positions: [V, 3] pattern [m].
    """
    depth = _depth_direction(frames, episode)
    scene = match_points(
        frames, depth if derivatives is None else concatenate_directions(derivatives, depth), episode, surface
    )
    parts = []
    for b, block in enumerate(RESIDUAL_BLOCKS):
        rows = block.rows(scene)
        if rows is not None and block.name == "edges":  # zeros are pieces of the rim that nobody sees
            visible = rows.residual != 0
            jacobian = None if rows.jacobian is None else rows.jacobian[visible]
            rows = ResidualRows(rows.residual[visible], jacobian, rows.frame[visible], rows.error_group[visible])
        if rows is not None and len(rows.residual):
            parts.append(
                _average(_assign_channels(block.name, rows, episode, surface), b, episode, surface, rest_positions)
            )
    return BinnedResiduals(*(torch.cat(column) for column in zip(*parts, strict=True)))


def finite_differences(base: Frames, shifted: Sequence[Frames], steps: Sequence[float]) -> Frames:
    """Return finite differences of frames along K directions."""

    def differentiate(field: Callable[[Frames], Tensor]) -> Tensor:
        return torch.stack([(field(s) - field(base)) / h for s, h in zip(shifted, steps, strict=True)])

    wrench = {name: differentiate(lambda f, name=name: f.wrench[name]) for name in base.wrench}
    return Frames(
        differentiate(lambda f: f.x), differentiate(lambda f: f.v), wrench, differentiate(lambda f: f.rim_offset)
    )


def concatenate_directions(first: Frames, second: Frames) -> Frames:
    """Return the derivatives along the directions of both."""
    wrench = {name: torch.cat([first.wrench[name], second.wrench[name]]) for name in first.wrench}
    return Frames(
        torch.cat([first.x, second.x]),
        torch.cat([first.v, second.v]),
        wrench,
        torch.cat([first.rim_offset, second.rim_offset]),
    )


def _depth_direction(frames: Frames, episode: Episode) -> Frames:
    """Return the direction [1, ...] away from the episode's only camera; zero without one."""
    x = torch.zeros_like(frames.x)
    if episode.camera_position is not None:
        x = torch.nn.functional.normalize(frames.x - episode.camera_position, dim=-1)
    wrench = {name: torch.zeros_like(w)[None] for name, w in frames.wrench.items()}
    return Frames(x[None], torch.zeros_like(frames.v)[None], wrench, torch.zeros_like(frames.rim_offset)[None])


def _assign_channels(name: str, rows: ResidualRows, episode: Episode, surface: ObservedSurface) -> ResidualRows:
    """Make the patch three times the part plus the axis; a marker joins the part of the fabric that it is on."""
    group = rows.error_group
    if name == "markers" and episode.marker_places is not None:
        parts = surface.error_groups_at(episode.marker_places.corners, episode.marker_places.weights)
        group = 3 * parts[rows.error_group // 3] + rows.error_group % 3
    elif name in ("points", "edges"):
        group = 3 * rows.error_group
    return rows._replace(error_group=group)


def _average(
    rows: ResidualRows, block: int, episode: Episode, surface: ObservedSurface, rest_positions: Tensor
) -> BinnedResiduals:
    position = _part_positions(BLOCK_NAMES[block], surface, rest_positions)[rows.error_group // 3]
    times = episode.times.to(rows.residual)
    window = ((times - times[0]) / BIN_SECONDS + 1e-6).floor().long()[rows.frame]  # stamps are rounded
    group, index = torch.unique(rows.error_group * MAX_BINS + window, return_inverse=True)
    n_bins = len(group)

    def add(values: Tensor) -> Tensor:
        return torch.zeros(n_bins, *values.shape[1:], dtype=values.dtype).index_add(0, index, values)

    inlier = _find_inliers(rows.residual, index, n_bins).to(rows.residual)
    count = add(inlier)
    usual_count = int(add(torch.ones_like(inlier)).median())  # a slow stream has few rows in a bin, and no outliers
    min_count = MIN_ROWS_PER_BIN if usual_count > MIN_ROWS_PER_BIN else max(1, min(usual_count, MIN_ROWS_PER_BIN - 1))
    weight = inlier / count.clamp(min=1.0)[index]
    mean = add(weight * rows.residual)
    row_std = add(weight * (rows.residual - mean[index]) ** 2).sqrt()
    slopes = add(weight[:, None] * rows.jacobian)  # type: ignore[operator]
    # markers may have cameras of their own
    depth_slope = torch.zeros_like(mean) if BLOCK_NAMES[block] == "markers" else slopes[:, -1]
    bins = BinnedResiduals(
        value=mean,
        jacobian=slopes[:, :-1],
        count=count,
        row_std=row_std,
        block=torch.full((n_bins,), block),
        channel=group // MAX_BINS,
        window=group % MAX_BINS,
        rest_position=add(weight[:, None] * position),
        time=add(weight * times[rows.frame]),
        roughness=torch.zeros_like(mean),
        depth_slope=depth_slope,
    )
    return bins.select(count >= min_count)


def _find_inliers(value: Tensor, index: Tensor, n_bins: int) -> Tensor:
    """Return [R] bool, rows near the median of their bin: a bin may be far off, a single point may not."""
    counts = torch.bincount(index, minlength=n_bins)
    first = counts.cumsum(0) - counts

    def bin_medians(values: Tensor) -> Tensor:
        order = torch.argsort(values)
        order = order[torch.argsort(index[order], stable=True)]
        return values[order][first + counts // 2]

    deviation = (value - bin_medians(value)[index]).abs()
    robust_std = MAD_TO_STD * bin_medians(deviation).clamp(min=1e-9)
    return deviation <= OUTLIER_ROBUST_STDS * robust_std[index]


def _part_positions(name: str, surface: ObservedSurface, rest_positions: Tensor) -> Tensor:
    """Return [parts, 3] m, the middle of each part on the pattern; zero for forces and torques."""
    if name in ("points", "markers"):
        middle = _group_means(surface.error_groups, rest_positions, ERROR_GROUPS_PER_AXIS**2)
        grid = (torch.arange(ERROR_GROUPS_PER_AXIS).to(rest_positions) + 0.5) / ERROR_GROUPS_PER_AXIS
        centres = torch.cartesian_prod(grid, grid)  # for parts without a vertex
        nearest = rest_positions[torch.cdist(centres, surface.pattern_fraction.to(rest_positions)).argmin(1)]
        return torch.where(
            torch.isin(torch.arange(ERROR_GROUPS_PER_AXIS**2), surface.error_groups)[:, None], middle, nearest
        )
    if name == "edges":
        rim = surface.rim
        middle = 0.5 * (rest_positions[rim.edges[:, 0]] + rest_positions[rim.edges[:, 1]])
        return _group_means(rim.labels[rim.piece], middle, int(rim.labels.max()) + 1)
    return torch.zeros(MAX_SENSORS, 3, dtype=rest_positions.dtype)


def _group_means(index: Tensor, values: Tensor, count: int) -> Tensor:
    total = torch.zeros(count, 3, dtype=values.dtype).index_add(0, index, values)
    return total / torch.bincount(index, minlength=count).clamp(min=1)[:, None]
